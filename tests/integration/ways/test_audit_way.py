"""Workflow of the audit log: the commands and the Python of the how-to page, on a real server."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import Role, UserCreate
from marey_schemas.event_kinds import AUDIT_KINDS

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "see-who-changed-access.md"
TEXT = PAGE.read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def project(marey: Marey, new_lab: Callable[[], ProjectHandle]) -> Iterator[ProjectHandle]:
    """The project `lab`, in which Ada was a reader first and is now a contributor."""
    made = new_lab()
    if "ada" not in {one.name for one in marey.users.list()}:
        marey.users.create(UserCreate(name="ada"))
    for role in (Role.READER, Role.CONTRIBUTOR):
        made.members.put("ada", role)
    yield made
    made.members.remove("ada")


def test_the_page_lists_exactly_the_kinds_of_entries() -> None:
    table = TEXT.partition("## What is recorded")[2]
    listed = [kind for row in table.splitlines() if row.startswith("| `") for kind in re.findall(r"`(\w+\.\w+)`", row)]
    assert sorted(listed) == sorted(AUDIT_KINDS)


def test_the_commands_of_the_page_show_who_did_what(run: CommandLine, project: ProjectHandle) -> None:
    whole, added, ada, ben = (shlex.split(line, comments=True)[1:] for line in blocks("sh")[0].splitlines())
    changed, first, created = [line.split() for line in run(*whole).stdout.splitlines() if "admin" in line]
    assert " ".join(changed[2:]) == "admin changed the role of the member ada role=contributor was=reader"
    assert " ".join(first[2:]) == "admin added the member ada role=reader"
    assert " ".join(created[2:]) == "admin created the project lab visibility=private"
    assert [line.split() for line in run(*added).stdout.splitlines() if "admin" in line] == [first]
    assert run(*ada).stdout.count("admin") == 2
    assert "admin" not in run(*ben).stdout
    of_server = run(*[word.replace("ben", "admin") for word in ben], "--subject", "ada").stdout
    assert "created the user" in of_server
    assert of_server.count(" lab ") >= 2


def test_programs_get_all_fields_and_are_told_that_there_is_more(run: CommandLine, project: ProjectHandle) -> None:
    told = run("audit", "lab", "--limit", 1, "--json")
    assert told.stderr == ""
    [entry] = json.loads(told.stdout)
    assert (entry["kind"], entry["about"], entry["body"]["was"]) == ("member.changed", "ada", "reader")
    assert entry["token"].startswith("token_")
    assert "older entries" in run("audit", "lab", "--limit", 1).stderr
    assert "older entries" not in run("audit", "lab", "--limit", 3).stderr
    at = entry["at"]
    assert json.loads(run("audit", "lab", "--since", at, "--json").stdout) == [entry]
    earlier = json.loads(run("audit", "lab", "--until", at, "--json").stdout)
    assert [one["kind"] for one in earlier] == ["member.added", "project.created"]
    assert json.loads(run("audit", "lab", "--since", "2999-01-01", "--json").stdout) == []


@pytest.mark.parametrize(("option", "text"), [("--kind", "member.made"), ("--since", "yesterday"), ("--until", "soon")])
def test_a_filter_that_cannot_be_read_is_explained(
    run: CommandLine, project: ProjectHandle, option: str, text: str
) -> None:
    refused = run("audit", "lab", option, text, status=2)
    assert repr(text) in refused.stderr
    assert ("member.added" if option == "--kind" else "2026-11-23") in refused.stderr


def test_the_python_of_the_page_reads_both_logs(marey: Marey, project: ProjectHandle) -> None:
    namespace: dict[str, Any] = {"marey": marey}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(blocks("python")[0], namespace)
    lines = printed.getvalue().splitlines()
    assert "admin changed the role of the member ada" in lines[0]
    assert any("first start" in line for line in lines)
