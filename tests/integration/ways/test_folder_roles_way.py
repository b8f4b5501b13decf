"""Workflow of roles in folders: the commands and the Python of the how-to page, on a real server."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import Role, UserChange, UserCreate

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "access.md"
SECTION = PAGE.read_text(encoding="utf-8").partition("## Roles in folders")[2]
PASSWORD = "correct horse battery"


def commands() -> list[list[str]]:
    """Return the arguments of each command in the section, without `marey`, in the order of the page."""
    (block,) = re.findall(r"```sh\n(.*?)```", SECTION, re.DOTALL)
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines() if line.strip()]


@pytest.fixture
def project(new_lab: Callable[[], ProjectHandle], marey: Marey) -> ProjectHandle:
    """The project of the page, with its folders and the readers Ada and Ben."""
    lab = new_lab()
    known = {user.name for user in marey.users.list()}
    for name in ("ada", "ben"):
        if name not in known:
            marey.users.create(UserCreate(name=name))
        marey.users.change(name, UserChange.model_validate({"password": PASSWORD}))
        lab.members.put(name, Role.READER)
    for path in ("mocap/team-b", "delivered"):
        lab.collections.create(path)
    return lab


def test_the_commands_of_the_page_give_show_and_end_roles(
    run: CommandLine, project: ProjectHandle, server: ServerProcess, tmp_path: Path
) -> None:
    ada, protect, ben, listing, end = commands()
    assert run(*ada).stderr == "ada is contributor in lab/mocap/team-b\n"
    assert run(*protect).stderr == "all members are reader in lab/delivered\n"
    run(*ben)
    rows = [line.split()[:3] for line in run(*listing).stdout.splitlines() if line.strip()]
    assert rows[-3:] == [
        ["delivered", "*", "reader"], ["delivered", "ben", "contributor"], ["mocap/team-b", "ada", "contributor"],
    ]  # fmt: skip
    shown = json.loads(run(*listing[:-1], "mocap", "--json").stdout)
    assert [(one["user"], one["folder"]) for one in shown] == [("ada", "mocap/team-b")]
    (tmp_path / "ada").mkdir()
    hers = CommandLine(server, tmp_path / "ada")
    hers("login", "--name", "ada", stdin=f"{PASSWORD}\n")
    refused = hers("member", "put", "lab", "ada", "maintainer", "--folder", "delivered", status=1).stderr
    assert "owner" in refused
    assert "is removed" in run(*end).stderr
    assert [one.user for one in project.members.in_folders.list("mocap")] == []
    assert "no folder" in run("member", "put", "lab", "ada", "reader", "--folder", "nowhere", status=2).stderr


def test_the_python_of_the_page_gives_and_lists_roles(project: ProjectHandle, marey: Marey) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", SECTION, re.DOTALL)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(PAGE), "exec"), {"marey": marey})
    assert printed.getvalue() == "mocap/team-b ada contributor\n"
    folder = project.collections.at("mocap/team-b")
    assert folder is not None
    assert folder.role is Role.OWNER
    project.members.in_folders.remove(folder, "ada")
    assert list(project.members.in_folders.list(user="ada")) == []
