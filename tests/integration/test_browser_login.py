"""Login with an identity provider on the command line: the commands and settings of the how-to page."""

from __future__ import annotations

import re
import shlex
import subprocess
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import httpx
import pytest
from tests.integration.test_identity_provider import ON_SQLITE, serving
from tests.support.command_line import run_here
from tests.support.identity_provider import FakeProvider, provider_running
from tests.support.rest_server import Server

from marey_client.cli.access import browser_login
from marey_client.cli.terminal.failures import WrongUsage
from marey_server.app import connect_database
from marey_server.process.doctor import examine
from marey_server.process.settings import Settings
from marey_server.store.database.connections import Database

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "sign-in-with-oidc.md"
TEXT = PAGE.read_text(encoding="utf-8")
ADDRESS = "https://marey.lab.example"


def commands() -> list[list[str]]:
    """Return the arguments of each command on the page, without `marey`, in the order of the page."""
    lines = [line.strip() for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line]


Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def provider() -> Iterator[FakeProvider]:
    with provider_running() as one:
        yield one


@pytest.fixture
def house(database: Database, tmp_path: Path, provider: FakeProvider) -> Iterator[Server]:
    with serving(database, tmp_path, provider) as server:
        yield server


@pytest.fixture
def run(house: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Function that runs `marey` as a user without a token, or with the token of `MAREY_TOKEN`."""
    for name, value in (("HOME", tmp_path), ("XDG_CONFIG_HOME", tmp_path), ("MAREY_DATA", tmp_path / "none")):
        monkeypatch.setenv(name, str(value))
    monkeypatch.setenv("MAREY_URL", house.address)
    monkeypatch.delenv("MAREY_TOKEN", raising=False)

    def call(*words: str, token: str | None = None, status: int = 0) -> subprocess.CompletedProcess[str]:
        given = [house.address if word == ADDRESS else word for word in words]
        with mock.patch.dict("os.environ", {"MAREY_TOKEN": token} if token else {}):
            done = run_here(given)
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return call


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[httpx.Response]:
    """List of the last pages that the browser shows; it opens each address that a login prints."""
    shown: list[httpx.Response] = []

    def browse(text: str) -> None:
        url = text.partition("\n")[2]

        def follow() -> None:
            with httpx.Client(follow_redirects=True, timeout=60) as browser:
                shown.append(browser.get(url))

        thread = threading.Thread(target=follow)
        thread.start()
        if "on this machine" not in text:
            thread.join(60)

    def code(_what: str) -> str:
        return shown[-1].text.partition("<code>")[2].partition("</code>")[0]

    monkeypatch.setattr(browser_login, "print_message", browse)
    monkeypatch.setattr(browser_login, "ask_secret", code)
    return shown


@ON_SQLITE
def test_the_commands_of_the_page_link_a_person_who_then_logs_in(
    run: Run, house: Server, pages: list[httpx.Response]
) -> None:
    doctor, create, link, links, login, paste, unlink, disable = commands()
    assert doctor == ["doctor"]
    admin = house.make_user("root", administrator=True, scopes=("read", "write", "admin"))
    refused = run(*paste, status=1)
    assert "not valid" in refused.stderr
    assert "marey user link NAME sub-ada" in pages[-1].text
    run(*create, token=admin)
    assert "can sign in as ada" in run(*link, token=admin).stderr

    done = run(*login)
    assert "as ada" in done.stderr
    assert "Return to the terminal" in pages[-1].text
    assert "as ada" in run(*paste).stderr
    assert "signed in as ada" in pages[-1].text
    stored = (Path(done.stderr.strip().rpartition(" ")[2])).read_text()
    assert "marey_" in stored
    assert "sub-ada" in run("user", "links").stdout

    found = run(*links, token=admin).stdout
    [link_id] = re.findall(r"identity_\w+", found)
    run(*[link_id if word == "LINK" else word for word in unlink], token=admin)
    assert "expired or revoked" in run("user", "show", status=1).stderr
    run(*disable, token=admin)


@ON_SQLITE
def test_options_that_do_not_fit_are_refused(run: Run) -> None:
    assert "only one of" in run("login", "--browser", "--with-token", status=2).stderr
    assert "--paste needs --browser" in run("login", "--paste", status=2).stderr
    assert "--name cannot be combined with --browser" in run("login", "--browser", "--name", "ada", status=2).stderr


def test_the_port_of_a_login_takes_only_the_code_of_its_sign_in() -> None:
    with browser_login.CodeListener() as listener:
        answers: list[int] = []

        def visit() -> None:
            queries = ("", "?sign_in=&code=x", "?sign_in=other&code=x", "?sign_in=mine", "?sign_in=mine&code=y")
            answers.extend(httpx.get(f"http://127.0.0.1:{listener.port}/{query}").status_code for query in queries)

        thread = threading.Thread(target=visit)
        thread.start()
        assert listener.wait("mine", 60) == "y"
        thread.join(60)
        assert answers == [404] * 4 + [200]
        listener.code = None
        begun_s = time.monotonic()
        with pytest.raises(WrongUsage, match="in time"):
            listener.wait("mine", 0.05)
        assert time.monotonic() - begun_s < 60


@ON_SQLITE
def test_the_settings_of_the_page_are_valid_and_doctor_checks_them(
    database: Database, tmp_path: Path, provider: FakeProvider
) -> None:
    written = {
        key: value
        for block in re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
        for key, value in tomllib.loads(block).items()
    }
    secret = tmp_path / "oidc-secret"
    secret.write_text("s\n")
    secret.chmod(0o600)
    written |= {"oidc_client_secret_file": secret, "oidc_issuer": provider.url}
    settings = Settings(data=tmp_path, **written)

    def finding(check: str = "identity provider") -> tuple[str, str]:
        every = {one.check: one for one in examine(settings, {}, connect_database)}
        return every[check].state, every[check].detail

    state, detail = finding()
    assert state == "ok"
    [uri] = re.findall(r"```\n(https\S+)\n```", TEXT)
    assert uri in detail
    secret.chmod(0o604)
    assert finding("secrets") == ("warning", f"all users can open {secret}; run `chmod o-rwx {secret}`.")
    secret.chmod(0o600)
    assert finding("secrets")[0] == "ok"
    provider.fault = "issuer"
    assert finding() == ("fault", mock.ANY)
    host = urlsplit(uri).netloc
    for wrong, reason in (
        ({"public_url": None}, "public_url"),
        ({"public_url": f"http://{host}"}, "https"),
        ({"oidc_issuer": f"http://{host}"}, "https"),
        ({"oidc_issuer": f"https://u:p@{host}"}, "https"),
        ({"oidc_issuer": f"https://{host}/?x=1"}, "https"),
        ({"oidc_client_id": None}, "oidc_client_id"),
        ({"oidc_scopes": ("profile",)}, "openid"),
        ({"oidc_allowed_values": ()}, "together"),
        ({"oidc_client_secret_file": tmp_path / "missing"}, "cannot be read"),
    ):
        with pytest.raises(ValueError, match=reason):
            Settings(data=tmp_path, **dict[str, Any](written, **wrong))
