"""Lookup of the server's address and the token."""

import json
import resource
from pathlib import Path

import httpx
import pytest

from marey_client import Marey, credentials, errors
from marey_client.retries import ONCE

SERVER = "https://marey.example.org"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    return {"XDG_CONFIG_HOME": str(tmp_path / "config"), "MAREY_DATA": str(tmp_path / "data")}


def write_secret(path: Path, text: str, mode: int = 0o600) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(mode)
    return path


def test_the_address_comes_from_a_flag_or_a_variable_by_its_new_or_earlier_name(environment: dict[str, str]) -> None:
    assert credentials.resolve(None, None, {**environment, "MAREY_URL": SERVER}).url == SERVER
    both = {**environment, "MAREY_SERVER": SERVER, "MAREY_URL": "http://127.0.0.1:9"}
    assert credentials.resolve(None, None, both).url == SERVER
    assert credentials.resolve("http://127.0.0.1:8", None, both).url == "http://127.0.0.1:8"


def test_a_token_file_comes_before_the_variable_and_that_before_the_stored_login(
    environment: dict[str, str], tmp_path: Path
) -> None:
    credentials.store_login(credentials.logins_path(environment), SERVER, "stored")
    assert credentials.resolve(SERVER, None, environment).token == "stored"
    environment["MAREY_TOKEN"] = "variable"
    assert credentials.resolve(SERVER, None, environment).token == "variable"
    file = write_secret(tmp_path / "token", "from-file\n")
    assert credentials.resolve(SERVER, file, environment).token == "from-file"


def test_a_token_file_is_read_again_when_it_changes_and_a_broken_one_changes_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_secret(tmp_path / "token", "marey_a_old\n")
    sent: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append(request.headers["Authorization"].removeprefix("Bearer "))
        return httpx.Response(200, json={"user": None, "scopes": []})

    with Marey(SERVER, credentials.TokenFile(path), http=httpx.MockTransport(answer), retries=ONCE) as marey:
        pinned = marey.transport.with_present_token()
        marey.me()
        credentials.write_private(path, "marey_b_new\n")
        assert not pinned.has_token_of(marey.transport)
        pinned.send("GET", "/me")
        for spoil in (lambda: path.write_text("two words"), path.unlink):
            marey.me()
            spoil()
            marey.me()
        write_secret(path, "marey_c_newest")
        marey.me()
    assert sent == ["marey_a_old", "marey_a_old", *["marey_b_new"] * 4, "marey_c_newest"]
    assert caplog.text.count("the token that was read before stays in use") == 2
    assert "two words" not in caplog.text


def test_a_private_file_is_replaced_in_one_step_and_a_link_stays_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, link = write_secret(tmp_path / "kept" / "token", "before"), tmp_path / "link"
    link.symlink_to(path)
    credentials.write_private(link, "after")
    assert (link.is_symlink(), path.read_text(), path.stat().st_mode & 0o777) == (True, "after", 0o600)

    def fail(_handle: int) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        credentials.write_private(link, "half")
    assert [(one.name, one.read_text()) for one in path.parent.iterdir()] == [("token", "after")]


def test_a_session_without_an_address_goes_where_the_command_line_goes(
    environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {**environment, "MAREY_URL": SERVER, "MAREY_TOKEN": "variable"}.items():
        monkeypatch.setenv(name, value)
    sent = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        return httpx.Response(401, json={})

    with Marey(http=httpx.MockTransport(answer), retries=ONCE) as marey, pytest.raises(errors.RequestFailed):
        marey.me()
    assert str(sent[0].url).startswith(SERVER)
    assert sent[0].headers["Authorization"] == "Bearer variable"


def test_the_server_is_the_one_named_or_the_one_logged_in_to_last(environment: dict[str, str]) -> None:
    path = credentials.logins_path(environment)
    assert credentials.resolve(None, None, environment).url == credentials.DEFAULT_URL
    credentials.store_login(path, SERVER, "a")
    assert credentials.resolve(None, None, environment).url == SERVER
    assert credentials.resolve("http://other.test/", None, environment).url == "http://other.test"


def test_the_administrators_token_serves_only_for_a_server_on_this_machine(
    environment: dict[str, str], tmp_path: Path
) -> None:
    write_secret(tmp_path / "data" / "admin.token", "local")
    assert credentials.resolve("http://127.0.0.1:8460", None, environment).token == "local"
    assert credentials.resolve(SERVER, None, environment).token is None


@pytest.mark.parametrize(
    ("settings", "found"), [("data = 'kept'", "marey_local"), ("data = [", None), ("data = 3", None)]
)
def test_the_data_folder_that_settings_name_is_known_here_too(
    environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: str, found: str | None
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "admin.token").write_text("marey_local\n")
    (tmp_path / "kept" / "admin.token").chmod(0o600)
    (tmp_path / "marey.toml").write_text(settings)
    without_data = {name: text for name, text in environment.items() if name != "MAREY_DATA"}
    assert credentials.resolve("http://localhost:8460", None, without_data).token == found


def test_logins_are_readable_by_their_owner_alone_and_can_be_forgotten(environment: dict[str, str]) -> None:
    path = credentials.logins_path(environment)
    credentials.store_login(path, SERVER, "secret")
    assert path.stat().st_mode & 0o777 == 0o600
    assert credentials.forget_login(path, SERVER)
    assert "secret" not in path.read_text()
    assert not credentials.forget_login(path, SERVER)
    assert credentials.resolve(None, None, environment).url == credentials.DEFAULT_URL


@pytest.mark.parametrize(
    ("text", "mode", "reason"),
    [
        ("", 0o600, "one token"),
        ("two words", 0o600, "one token"),
        ("token", 0o644, "chmod 600"),
        ("tökén", 0o600, "contains no token"),
    ],
)
def test_files_that_hold_no_token_or_that_others_can_read_are_refused(
    tmp_path: Path, text: str, mode: int, reason: str
) -> None:
    with pytest.raises(errors.BadCredentialFile, match=reason):
        credentials.read_secret(write_secret(tmp_path / "token", text, mode))


def test_a_second_server_gets_no_token_that_is_meant_for_the_first(environment: dict[str, str], tmp_path: Path) -> None:
    write_secret(tmp_path / "data" / "admin.token", "marey_a_first\n")
    environment["MAREY_TOKEN"] = "marey_b_first"
    assert credentials.resolve_other("http://127.0.0.1:9999/", None, environment).token is None
    credentials.store_login(credentials.logins_path(environment), SERVER, "marey_c_second")
    assert credentials.resolve_other(SERVER + "/", None, environment).token == "marey_c_second"
    assert credentials.resolve_other("https://third.example", None, environment).token is None
    file = write_secret(tmp_path / "third", "marey_d_third\n")
    assert credentials.resolve_other("https://third.example", file, environment).token == "marey_d_third"
    with pytest.raises(errors.BadAddress):
        credentials.resolve_other("third.example", None, environment)


def test_a_damaged_file_of_logins_is_an_error_that_says_what_to_do(environment: dict[str, str]) -> None:
    path = write_secret(credentials.logins_path(environment), json.dumps({"tokens": 3}))
    with pytest.raises(errors.BadCredentialFile, match="log in again"):
        credentials.read_logins(path)


def test_tokens_do_not_show_in_representations(environment: dict[str, str]) -> None:
    environment["MAREY_TOKEN"] = "secret-token"
    credentials.store_login(credentials.logins_path(environment), SERVER, "secret-token")
    found = credentials.resolve(SERVER, None, environment)
    assert "secret-token" not in repr(found)
    assert "secret-token" not in repr(credentials.read_logins(credentials.logins_path(environment)))


def test_a_login_that_there_is_no_room_for_leaves_no_token_behind(tmp_path: Path) -> None:
    path = tmp_path / "credentials.json"
    credentials.store_login(path, SERVER, "kept")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            credentials.store_login(path, "https://other.test", "lost")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == [path]
    assert dict(credentials.read_logins(path).tokens) == {SERVER: "kept"}


def test_a_credential_that_systemd_opened_to_its_service_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "worker-token"
    file.write_text("marey_secret")
    file.chmod(0o440)
    with pytest.raises(errors.BadCredentialFile, match="can be read by other users"):
        credentials.read_secret(file)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert credentials.read_secret(file) == "marey_secret"
    file.chmod(0o444)
    with pytest.raises(errors.BadCredentialFile, match="can be read by other users"):
        credentials.read_secret(file)
