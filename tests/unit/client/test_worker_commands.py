"""Commands `worker` and `worker ls`."""

import json
from contextlib import nullcontext
from datetime import UTC, datetime
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from marey_client import embedded
from marey_client.cli import processes
from marey_client.cli.app import app
from marey_client.cli.terminal.output import print_json, print_table
from marey_schemas.queue.workers import Worker


def test_a_worker_starts_without_a_subcommand_and_workers_are_listed_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[dict[str, object]] = []
    monkeypatch.setattr(embedded, "work", lambda _, **options: started.append(options))
    assert CliRunner().invoke(app, ["worker", "--slots", "2"]).exit_code == 0
    assert [one["slots"] for one in started] == [2]
    known = Worker(name="host:1", alive=False, seen_at=datetime(2026, 11, 27, tzinfo=UTC), running=0)
    monkeypatch.setattr(processes, "connect", lambda _: nullcontext(SimpleNamespace(workers=lambda: [known])))
    told = CliRunner().invoke(app, ["worker", "ls"]).stdout
    assert "host:1" in told
    assert "away" in told
    assert len(started) == 1


def test_a_table_shows_control_characters_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("worker",), [("Ångström\x1b]0;title\x07\x9b31m",)])
    assert r"Ångström\x1b]0;title\x07\x9b31m" in capsys.readouterr().out


def test_json_shows_control_characters_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    names = {"Ångström\x1b]0;title\x07\x7f\x80\x9b31m\x9f": "\xa0é"}
    print_json(names)
    printed = capsys.readouterr().out
    assert r"Ångström\u001b]0;title\u0007\u007f\u0080\u009b31m\u009f" in printed
    assert json.loads(printed) == names
