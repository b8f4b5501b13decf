"""Workflow of invitations: the commands and the Python of the how-to page, on a real server."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import Login, Role, UserCreate
from marey_schemas.invitations import CODE_PREFIX, MAX_DAYS, MAX_USES

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "invite-people.md"
TEXT = PAGE.read_text(encoding="utf-8")
PASSWORD = "correct horse battery"


def commands() -> list[list[str]]:
    """Return the arguments of each command on the page, without `marey`, in the order of the page."""
    lines = [line.strip() for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line]


@pytest.fixture
def project(new_lab: Callable[[], ProjectHandle]) -> ProjectHandle:
    return new_lab()


@pytest.fixture
def guest(server: ServerProcess, marey: Marey, tmp_path: Path) -> CommandLine:
    """The command line of the user `guest-<n>`, who is a member of no project."""
    name = f"guest-{len(list(marey.users.list()))}"
    marey.users.create(UserCreate.model_validate({"name": name, "password": PASSWORD}))
    folder = tmp_path / "guest"
    folder.mkdir()
    command_line = CommandLine(server, folder)
    command_line("login", "--name", name, stdin=f"{PASSWORD}\n")
    return command_line


def code_in(output: str) -> tuple[str, str]:
    """Return the prefix and the code of an invitation that a command has printed."""
    found = dict(line.split() for line in output.splitlines())
    return found["prefix"], found["code"]


def test_the_commands_of_the_page_let_a_user_in(run: CommandLine, guest: CommandLine, project: ProjectHandle) -> None:
    invite, listing, accept = commands()[:3]
    made = run(*invite)
    prefix, code = code_in(made.stdout)
    assert code.startswith(f"{CODE_PREFIX}{prefix}_")
    assert "never shows it again" in made.stderr
    listed = run(*listing).stdout
    assert prefix in listed
    assert "animation team" in listed
    assert code not in listed
    assert guest(*accept, stdin=f"{code}\n").stderr == "you are contributor of lab\n"
    assert json.loads(guest(*accept, "--json", stdin=f"{code}\n").stdout)["joined"]
    assert prefix not in run(*listing).stdout

    _, code = code_in(run("member", "invite", "lab", "--role", "reader").stdout)
    assert "contributor of lab already; the invitation was not used" in guest(*accept, stdin=code).stderr
    assert [one["uses_left"] for one in json.loads(run(*listing, "--json").stdout)] == [1]


def test_the_commands_of_the_page_create_an_account(
    run: CommandLine, server: ServerProcess, marey: Marey, project: ProjectHandle, tmp_path: Path
) -> None:
    invite, listing, login, _, withdraw = commands()[3:]
    assert login[1:3] == ["--server", "https://marey.internal"]
    prefix, code = code_in(run(*invite).stdout)
    assert prefix in run(*listing).stdout
    name = f"ada-{prefix}"
    home = tmp_path / "new"
    home.mkdir()
    new = CommandLine(server, home)
    words = ["login", "--name", name, *login[3:]]
    done = new(*words, stdin=f"{code}\n{PASSWORD}\n")
    assert f"user {name} is created, as reader of lab" in done.stderr
    assert f"as {name}" in done.stderr
    assert json.loads(new("project", "show", "lab", "--json").stdout)["role"] == "reader"
    assert marey.sign_in(Login.model_validate({"name": name, "password": PASSWORD})).user == name

    prefix, code = code_in(run("user", "invite").stdout)
    assert "is withdrawn" in run(*[prefix if word == "PREFIX" else word for word in withdraw]).stderr
    refused = new("login", "--invitation", "--name", "ben", stdin=f"{code}\n{PASSWORD}\n", status=1)
    assert "not valid" in refused.stderr
    assert code not in refused.stderr


def test_an_owner_withdraws_by_prefix_and_is_warned_of_a_code(run: CommandLine, project: ProjectHandle) -> None:
    prefix, code = code_in(run("member", "invite", "lab", "--role", "reader").stdout)
    refused = run("member", "withdraw", "lab", code, status=2)
    assert "give the prefix or the id" in refused.stderr
    assert code not in refused.stderr
    withdraw = [prefix if word == "PREFIX" else word for word in commands()[6]]
    assert run(*withdraw).stderr == f"the invitation {prefix} is withdrawn\n"
    assert "no open invitation" in run(*withdraw, status=1).stderr


def test_wrong_arguments_are_refused_with_what_to_write_instead(run: CommandLine, project: ProjectHandle) -> None:
    assert "the roles are" in run("member", "invite", "lab", "--role", "king", status=2).stderr
    assert "give both" in run("user", "invite", "--project", "lab", status=2).stderr
    for option, most in (("--days", MAX_DAYS), ("--uses", MAX_USES)):
        for words in (("member", "invite", "lab", "--role", "reader"), ("user", "invite")):
            assert f"at most {most}" in run(*words, option, most + 1, status=2).stderr
            assert f"at most {most}" in run(*words, "--help").stdout.replace("\n", " ").replace("  ", "")
    assert "only one of" in run("login", "--invitation", "--with-token", status=2).stderr
    assert "Invitation code" in run("member", "accept", status=2).stderr


def test_the_python_of_the_page_works(marey: Marey, project: ProjectHandle) -> None:
    printed = io.StringIO()
    namespace: dict[str, Any] = {"marey": marey}
    with contextlib.redirect_stdout(printed):
        exec(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[0], namespace)
    assert printed.getvalue().split()[0] == namespace["made"].prefix
    assert printed.getvalue().split()[-1] == "5"
    assert namespace["made"].role is Role.READER
    assert list(project.invitations.list()) == []
