"""Start of the workers of a server: launchers by name, and the arguments that each launcher gets."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from tests.support.fake_launcher import FakeLauncher
from tests.support.patience import PATIENCE_S

from marey_server.access.principal import SYSTEM
from marey_server.app import create_app
from marey_server.launchers import pools
from marey_server.launchers.launcher import LaunchContext, LauncherUnusable, WorkerRequest
from marey_server.launchers.local import LocalLauncher
from marey_server.launchers.pools import find_launcher, keeping_workers
from marey_server.process.settings import Settings
from marey_server.process.worker_pools import WorkerPool
from marey_server.store import users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database

made: list[tuple[LaunchContext, FakeLauncher]] = []


def make_launcher(context: LaunchContext) -> FakeLauncher:
    """Launcher of another package."""
    made.append((context, FakeLauncher()))
    return made[-1][1]


@pytest.fixture(autouse=True)
def other_package(monkeypatch: pytest.MonkeyPatch) -> None:
    made.clear()
    points = [EntryPoint("cloud", f"{__name__}:make_launcher", "marey.launchers")]
    points.append(EntryPoint("broken", "marey_server.nowhere:launch", "marey.launchers"))
    monkeypatch.setattr(pools, "entry_points", lambda group: points if group == "marey.launchers" else [])


def test_a_launcher_is_found_by_its_name() -> None:
    assert find_launcher("local") is LocalLauncher
    assert find_launcher("cloud") is make_launcher
    with pytest.raises(
        LauncherUnusable, match="there is no launcher 'slrum'; choose one of broken, cloud, kubernetes, local, slurm"
    ):
        find_launcher("slrum")
    with pytest.raises(LauncherUnusable, match="'broken' cannot be loaded: No module named"):
        find_launcher("broken")


def test_each_pool_gets_a_launcher_with_its_own_token_and_options(database: Database, tmp_path: Path) -> None:
    database.write(SYSTEM, users.ensure_first_administrator)
    pool = WorkerPool(name="gpu", labels={"gpu": "a100"}, least=2, most=3, memory_mb=512, options={"queue": "long"})
    settings = Settings(
        data=tmp_path, launcher="cloud", pools=(pool,), launcher_options={"queue": "short", "zone": "b"},
        worker_url="https://marey.internal",
    )  # fmt: skip
    app = create_app(settings, database)

    async def run_until_started() -> None:
        async with asyncio.timeout(PATIENCE_S), keeping_workers(app.services, "http://127.0.0.1:1"):
            while not made[0][1].keys:
                await asyncio.sleep(0.01)

    asyncio.run(run_until_started())
    ((context, launcher),) = made
    assert (context.pool, context.url, context.options) == (
        "gpu", "https://marey.internal", {"queue": "long", "zone": "b"},
    )  # fmt: skip
    assert launcher.requests == [WorkerRequest(labels={"gpu": "a100"}, memory_bytes=512 * 2**20)]
    assert len(launcher.states) == 2
    assert launcher.closed
    assert launcher.stopped == [], "workers that outlive the server continue"
    assert context.token_file.read_text().strip() == context.token
    assert database.read(SYSTEM, tokens.resolve_token, context.token).labels == {"gpu": "a100"}


def test_servers_at_free_ports_of_one_machine_keep_the_tokens_of_each_others_workers(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "LocalLauncher", make_launcher)
    database.write(SYSTEM, users.ensure_first_administrator)
    app = create_app(Settings(data=tmp_path, port=0, local_workers=1), database)

    async def run_both() -> None:
        async with (
            keeping_workers(app.services, "http://127.0.0.1:50001"),
            keeping_workers(app.services, "http://[::1]:50002"),
        ):
            for context, _ in made:
                assert database.read(SYSTEM, tokens.resolve_token, context.token).scopes == ("work",)

    asyncio.run(run_both())
    assert len(made) == 2


def test_a_launcher_that_does_not_exist_is_an_error_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "marey.toml"
    file.write_text('launcher = "slrum"\n')  # without pools, which would use it
    serve = [sys.executable, "-m", "marey_client.cli", "serve", "--port", "0"]
    done = subprocess.run(serve, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "invalid setting: launcher: there is no launcher 'slrum'; choose one of" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_workers_beside_the_server_are_named_after_its_machine_and_port(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several servers may use one database, and their workers appear in one list."""
    database.write(SYSTEM, users.ensure_first_administrator)
    monkeypatch.setattr(pools, "LocalLauncher", make_launcher)
    app = create_app(Settings(data=tmp_path, port=0, local_workers=2), database)

    async def start_at(port: int) -> tuple[str, ...]:
        made.clear()
        async with keeping_workers(app.services, f"http://127.0.0.1:{port}"):
            ((context, launcher),) = made
            return tuple(f"{context.pool}-{key}" for key in launcher.keys)

    machine = socket.gethostname()
    assert asyncio.run(start_at(8460)) == (f"local-{machine}-8460",)
    assert asyncio.run(start_at(8461)) == (f"local-{machine}-8461",)
