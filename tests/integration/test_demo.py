"""The demonstration, run as a new user runs it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.timeout(300)


def demo(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    surroundings = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
    command = [sys.executable, "-m", "marey_client.cli", "demo", "--data", str(folder / "data"), *arguments]
    done = subprocess.run(command, env=surroundings, capture_output=True, text=True, cwd=folder, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_the_demonstration_tells_how_good_the_motion_is_and_does_nothing_twice(tmp_path: Path) -> None:
    done = demo(tmp_path)
    told = done.stdout
    assert f"ls demo --token-file {tmp_path}/data/admin.token" in done.stderr
    sentence = told.splitlines()[0]
    assert "trajectories" in sentence
    assert "retargeted clips: those whose root gets 0.5 m away within 1 s" in told

    again = json.loads(demo(tmp_path, "--json").stdout)
    assert again["evaluation"]["verdict"] == sentence
    assert again["evaluation"]["trials"] == 50
    assert 0 < again["evaluated_clips"] < again["retargeted_clips"]
    assert again["statuses"] == {"unchanged": again["files"]}
    with open(again["evaluation_report"], encoding="utf-8") as page:
        assert "</html>" in page.read()
