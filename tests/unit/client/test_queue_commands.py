"""Commands of schedules and scripts: the requests that their options make."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer

from marey_client.cli.queue import schedules, scripts

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


def test_a_run_of_a_script_has_the_options_of_other_jobs_for_message_commit_and_consent(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scripts, "connect", lambda context: script.marey())
    declaration = {
        "repository": "https://git.invalid/motion", "commit": "a" * 40, "argv": ["python", "x.py", "{output:fields}"],
        "outputs": {"fields": {"kind": "fields"}},
    }  # fmt: skip
    shown = {
        "name": "measure", "project": "lab", "description": "", "declaration": declaration, "author": "ada",
        "created_at": NOW,
    }  # fmt: skip
    job = {
        "id": "job_1", "project": "lab", "kind": "script", "state": "queued", "params": {}, "inputs": {},
        "into": "made", "priority": 0, "seed": 7, "attempt": 0, "fence": 0, "max_attempts": 3, "author": "ada",
        "created_at": NOW, "run_at": NOW, "rev": 1,
    }  # fmt: skip
    script.answers = [httpx.Response(200, json=shown), httpx.Response(201, json=job)]
    words = ["script", "run", "lab", "measure", "--seed", "7", "-m", "why", "--commit-to", "gaits@trial"]
    done = run_here([*words, "--commit-message", "copies", "--allow-expired-consent", "agreed again", "--no-wait"])
    assert (done.returncode, done.stdout) == (0, "job_1\n"), done.stderr
    sent = json.loads(script.requests[-1].content)
    assert (sent["seed"], sent["message"], sent["consent_reason"]) == (7, "why", "agreed again")
    target = [sent["commit"][name] for name in ("dataset", "branch", "message")]
    assert target == ["gaits", "trial", "copies"]
