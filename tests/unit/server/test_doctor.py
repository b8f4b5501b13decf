"""Command `marey doctor`: checks of a server's machine without a running server, and of a running server."""

import json
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from marey_client.cli.app import app
from marey_client.cli.doctor import check_server
from marey_client.marey import Marey
from marey_client.retries import ONCE
from marey_server import commands
from marey_server.app import open_database
from marey_server.process import doctor
from marey_server.process.settings import Settings
from marey_server.store.database.clock import set_high_water, wall_clock_us
from marey_server.store.database.opening import alone


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder with the database of a server that was stopped."""
    folder = tmp_path / "data"
    folder.mkdir(mode=0o700)
    open_database(Settings(data=folder)).close()
    return folder


def states(folder: Path, **settings: object) -> dict[str, tuple[str, str]]:
    return {check: (state, detail) for check, state, detail in commands.examine(data=folder, **settings)}


def test_a_sound_machine_has_no_faults(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "kernels_are_compiled", lambda: True)
    found = states(data)
    assert list(found) == ["settings", "disk", "data folder", "secrets", "database", "clock", "kernels"]
    assert {state for state, _ in found.values()} == {"ok"}


def test_secrets_that_other_users_can_read_are_found(data: Path, tmp_path: Path) -> None:
    url, secret = "postgresql://marey@127.0.0.1:1/marey", tmp_path / "password"
    secret.write_text("hidden-one")
    secret.chmod(0o604)
    state, detail = states(data, database_url=url, database_password_file=secret)["secrets"]
    assert (state, detail) == ("warning", f"all users can open {secret}; run `chmod o-rwx {secret}`.")
    secret.chmod(0o640)
    assert states(data, database_url=url, database_password_file=secret)["secrets"][0] == "ok"
    state, detail = states(data, database_url=url.replace("marey@", "marey:hidden-two@"))["secrets"]
    assert state == "warning"
    assert "MAREY_DATABASE_PASSWORD_FILE" in detail
    assert "hidden-two" not in detail


def test_each_fault_of_a_machine_is_found(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAREY_PROT", "1")
    monkeypatch.setattr(doctor, "kernels_are_compiled", lambda: False)
    data.chmod(0o755)
    with alone(data / "marey.db") as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '0001'")
    found = states(data, min_free_bytes=2**60)
    assert found["settings"] == ("warning", "MAREY_PROT has no effect; did you mean MAREY_PORT?")
    assert found["disk"][0] == found["database"][0] == "fault"
    assert "marey db upgrade" in found["database"][1]
    assert found["data folder"][0] == found["kernels"][0] == "warning"


def test_a_clock_that_is_ahead_is_found(data: Path) -> None:
    with alone(data / "marey.db") as connection:
        set_high_water(connection, wall_clock_us() + 3_600_000_000)
    assert states(data)["clock"][0] == "warning"


def test_a_missing_folder_is_a_fault_and_is_not_created(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["doctor", "--no-remote", "--json", "--data", str(tmp_path / "none")])
    assert done.exit_code == 1
    found = {one["check"]: one["state"] for one in json.loads(done.stdout)}
    assert found["data folder"] == found["database"] == "fault"
    assert not (tmp_path / "none").exists()


def test_an_invalid_setting_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAREY_PORT", "many")
    assert states(tmp_path)["settings"][0] == "fault"


def answers(ready: int, workers: httpx.Response) -> httpx.MockTransport:
    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/readyz":
            return httpx.Response(ready, json={"status": "ready"})
        return workers if request.url.path == "/api/v1/workers" else httpx.Response(200, json={"version": "9.9"})

    return httpx.MockTransport(answer)


def remote(ready: int, workers: httpx.Response) -> dict[str, str]:
    with Marey("http://server", "token", retries=ONCE, http=answers(ready, workers)) as marey:
        return {check: state for check, state, _ in check_server(marey)}


def test_a_running_server_is_checked_with_what_the_token_may_know() -> None:
    worker = {"name": "w", "alive": True, "seen_at": "2026-11-27T00:00:00Z", "running": 0, "kinds": ["import"]}
    listed = httpx.Response(200, json={"items": [worker]})
    assert remote(200, listed) == {"server": "ok", "version of the server": "warning", "workers": "warning"}
    assert remote(200, httpx.Response(403, json={"code": "forbidden", "title": "No", "status": 403}))["workers"] == "ok"
    assert remote(503, listed) == {"server": "fault"}
