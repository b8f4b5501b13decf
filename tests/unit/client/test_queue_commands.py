"""Commands of schedules and scripts: the requests that their options make."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer

from marey_client.cli.queue import schedules

NOW = "2026-01-01T00:00:00Z"


def test_a_schedule_can_be_created_paused(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(schedules, "connect", lambda context: script.marey())
    job = {"kind": "evaluate", "inputs": {"clips": {"collection": "studio"}}}
    (tmp_path / "job.json").write_text(json.dumps(job))

    def answer(request: httpx.Request) -> httpx.Response:
        wanted: dict[str, Any] = json.loads(request.content)
        given = {name: wanted[name] for name in ("name", "cron", "timezone", "job", "overlapping", "description")}
        return httpx.Response(
            200,
            json=given
            | {"project": "lab", "paused": wanted["paused"], "author": "ada", "next_at": None, "rev": 1}
            | {"created_at": NOW, "updated_at": NOW},
        )

    script.answers = [answer]
    words = ["schedule", "create", "lab", "nightly", "--cron", "0 3 * * *", "--job", str(tmp_path / "job.json")]
    done = run_here([*words, "--paused"])
    assert (done.returncode, done.stderr) == (0, "nightly is paused\n"), done
