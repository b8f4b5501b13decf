"""Arguments of `python -m marey_worker`, with which launchers start workers."""

import io
from pathlib import Path
from typing import Any

import pytest

from marey_client.credentials import Credential
from marey_worker import commands

URL = "http://127.0.0.1:9"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Credential, dict[str, Any]]]:
    """Credential and options of each worker that a test starts; no worker runs."""
    workers: list[tuple[Credential, dict[str, Any]]] = []
    monkeypatch.setattr(commands, "work", lambda credential, **options: workers.append((credential, options)))
    return workers


def test_every_argument_reaches_the_worker(
    started: list[tuple[Credential, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text("marey_secret")
    token.chmod(0o600)
    given = [
        "--server", URL, "--token-file", str(token), "--slots", "3", "--kind", "align", "--kind", "model",
        "--label", "gpu=a100", "--label", "site=", "--name", "rack-7", "--cache", str(tmp_path),
    ]  # fmt: skip
    monkeypatch.setattr("sys.argv", ["marey_worker", *given])
    commands.main()
    ((credential, options),) = started
    assert (credential.url, credential.token) == (URL, "marey_secret")
    assert options == {
        "slots": 3, "kinds": ("align", "model"), "labels": {"gpu": "a100", "site": ""}, "name": "rack-7",
        "cache": tmp_path, "attached": False,
    }  # fmt: skip


def test_an_attached_worker_reads_its_token_from_standard_input_and_has_defaults(
    started: list[tuple[Credential, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAREY_TOKEN", "marey_another")
    monkeypatch.setattr("sys.stdin", io.StringIO("marey_secret\n"))
    monkeypatch.setattr("sys.argv", ["marey_worker", "--server", URL, "--attached"])
    commands.main()
    ((credential, options),) = started
    assert (credential.url, credential.token) == (URL, "marey_secret")
    assert options == {"slots": 1, "kinds": (), "labels": {}, "name": None, "cache": None, "attached": True}
