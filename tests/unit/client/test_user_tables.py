"""Users from CSV files: all rows are checked before anybody is created."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer

from marey_client.cli.access import user_tables
from marey_client.cli.terminal.failures import WrongUsage

NOW = "2026-01-01T00:00:00Z"
TABLE = """name,display_name,administrator,project,role
ada,Ada L.,,lab,contributor
ada,,,mocap,reader
ben,,yes,,
eve,,,lab,reader
eve,Eve,no,,
"""


def table(folder: Path, text: str) -> Path:
    path = folder / "team.csv"
    path.write_text(text, encoding="utf-8-sig")
    return path


class Team:
    """Simulated server with the user ada, a contributor of the project lab; it records the requests."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str, Any]] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path.removeprefix("/api/v1")
        user = {"id": "u", "name": "ada", "administrator": False, "disabled": False, "created_at": NOW, "rev": 1}
        member = {"user": "ada", "role": "contributor", "since": NOW, "rev": 1}
        if request.method == "GET":
            held = {"/users": [user], "/projects/lab/members": [member], "/projects/mocap/members": []}
            return httpx.Response(200, json={"items": held[path]})
        self.sent.append((request.method, path, json.loads(request.content)))
        return httpx.Response(201, json=user if path == "/users" else member)


@pytest.fixture
def team(script: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> Team:
    found = Team()
    script.answers = [found] * 20
    monkeypatch.setattr(user_tables, "connect", lambda context: script.marey())
    return found


def test_each_user_is_created_once_and_joins_the_projects(team: Team, tmp_path: Path) -> None:
    done = run_here(["user", "import", str(table(tmp_path, TABLE))])
    assert (done.returncode, done.stdout + done.stderr) == (0, "2 users created, 1 existed; 2 memberships\n")
    assert [(method, path) for method, path, _ in team.sent] == [
        ("POST", "/users"),
        ("POST", "/users"),
        ("PUT", "/projects/mocap/members/ada"),
        ("PUT", "/projects/lab/members/eve"),
    ]
    assert [body["administrator"] for _, path, body in team.sent if path == "/users"] == [True, False]
    assert team.sent[1][2] == {"name": "eve", "display_name": "Eve", "administrator": False}


def test_the_role_of_a_member_changes_only_on_request(team: Team, tmp_path: Path) -> None:
    words = ["user", "import", str(table(tmp_path, "name,project,role\neve,lab,reader\nada,lab,reader\n"))]
    for more in (["--dry-run"], []):
        done = run_here([*words, *more])
        assert done.returncode == 2
        assert "row 3: the role of ada in lab is contributor, and would become reader" in done.stderr
        assert "--change-roles" in done.stderr
        assert team.sent == []
    assert run_here([*words, "--change-roles"]).returncode == 0
    assert ("PUT", "/projects/lab/members/ada", {"role": "reader"}) in team.sent


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("user\nada\n", "has no column `name`; the columns are name, display_name"),
        ("name,colour\nada,red\n", "unknown column 'colour'"),
        ("name\n", "has no rows"),
        ("name\nada\nBen B\n", "row 3: name: the text must have at most 64 lower-case letters"),
        ("name,administrator\nada,perhaps\n", "row 2: administrator: 'perhaps' must be yes or no"),
        ("name,project\nada,lab\n", "row 2: give both a project and a role"),
        ("name,project,role\nada,lab,emperor\n", "role: 'emperor' must be reader, contributor, maintainer or owner"),
        (
            "name,administrator\nada,no\nben,\nada,yes\n",
            "rows 2 and 4: they disagree on the administrator of ada",
        ),
        ("name,display_name\nada,Ada\nada,Eve\n", "rows 2 and 3: they disagree on the display_name of ada"),
        (
            "name,project,role\nada,lab,owner\nada,lab,reader\n",
            "rows 2 and 3: they disagree on the role in lab of ada",
        ),
        ("name\nada,lab\n", "more cells than the table has columns"),
        ("name\n\n\nada\nBen B\n", "row 5: name: "),
        ("name,name\nada,eve\n", "has several columns named 'name'"),
    ],
)
def test_a_wrong_table_is_refused_with_its_row(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        user_tables._read(table(tmp_path, text))
    assert told in str(refused.value)


def test_a_refused_row_is_named_with_what_is_stored(team: Team, tmp_path: Path, script: ScriptedServer) -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        if request.method == "PUT" and request.url.path.endswith("/lab/members/eve"):
            return httpx.Response(409)
        return team(request)

    script.answers = [refuse] * 20
    done = run_here(["user", "import", str(table(tmp_path, TABLE))])
    assert done.returncode == 1
    assert re.search(r"409.*team.csv, row 5; the rows before it are stored", done.stderr, re.DOTALL), done.stderr
