"""Users from CSV files: all rows are checked before anybody is created."""

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client.cli.access import user_tables
from marey_client.cli.access.user_tables import _read, _store
from marey_client.cli.terminal.failures import WrongUsage

NOW = "2026-01-01T00:00:00Z"
TABLE = """name,display_name,administrator,project,role
ada,Ada L.,,lab,contributor
ada,,,mocap,reader
ben,,yes,,
"""


def table(folder: Path, text: str) -> Path:
    path = folder / "team.csv"
    path.write_text(text, encoding="utf-8-sig")
    return path


def test_each_user_is_created_once_and_joins_the_projects(script: ScriptedServer, tmp_path: Path) -> None:
    sent: list[tuple[str, str, Any]] = []

    def answer(request: httpx.Request) -> httpx.Response:
        body = json.loads(request.content)
        sent.append((request.method, request.url.path.removeprefix("/api/v1"), body))
        user = {"id": "u", "name": "ada", "administrator": False, "disabled": False, "created_at": NOW, "rev": 1}
        return httpx.Response(201, json={**user, "user": "ada", "role": "reader", "since": NOW})

    script.answers = [answer] * 10
    _store(script.marey(), _read(table(tmp_path, TABLE)), {"ada", "ben"})
    assert [(method, path) for method, path, _ in sent] == [
        ("POST", "/users"),
        ("PUT", "/projects/lab/members/ada"),
        ("PUT", "/projects/mocap/members/ada"),
        ("POST", "/users"),
    ]
    assert sent[0][2] == {"name": "ada", "display_name": "Ada L.", "administrator": False}
    assert (sent[1][2]["role"], sent[3][2]["administrator"]) == ("contributor", True)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("user\nada\n", "has no column `name`; the columns are name, display_name"),
        ("name,colour\nada,red\n", "unknown column 'colour'"),
        ("name\n", "has no rows"),
        ("name\nada\nBen B\n", "row 3: name: the text must have at most 64 lower-case letters"),
        ("name,administrator\nada,perhaps\n", "row 2: administrator: 'perhaps' is neither yes nor no"),
        ("name,project\nada,lab\n", "row 2: give both a project and a role"),
        ("name,project,role\nada,lab,emperor\n", "role: 'emperor' must be reader, contributor, maintainer or owner"),
        ("name\nada,lab\n", "more cells than the file has columns"),
    ],
)
def test_a_wrong_table_is_refused_with_its_row(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        user_tables._read(table(tmp_path, text))
    assert told in str(refused.value)
