"""The demonstration, run as by a new user."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

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
    assert "retargeted clips: those whose root moves at least 0.5 m within 1 s" in told

    again = json.loads(demo(tmp_path, "--json").stdout)
    assert again["evaluation"]["verdict"] == sentence
    assert again["evaluation"]["trials"] == 50
    assert 0 < again["evaluated_clips"] < again["retargeted_clips"]
    assert again["statuses"] == {"unchanged": again["files"]}
    version = again["version"]
    assert (version["dataset"], version["tag"], version["entries"]) == ("results", "v1", again["retargeted_clips"] + 1)
    assert f"{version['edited']} was smoothed on a branch and merged" in told
    assert Path(version["picture"]).read_text("utf-8").endswith("</svg>\n")
    with open(again["evaluation_report"], encoding="utf-8") as page:
        assert "</html>" in page.read()


def test_a_run_with_other_files_reports_on_these_alone(tmp_path: Path) -> None:
    for name, speed_m_s in (("first", 1.3), ("second", 1.6)):
        (tmp_path / name).mkdir()
        walk = write_bvh(generate_gait(speed_m_s, 0.4, 3.0))
        (tmp_path / name / f"{name}.bvh").write_bytes(walk)
    reports = [json.loads(demo(tmp_path, name, "--json").stdout) for name in ("first", "second")]
    for name, report in zip(("first", "second"), reports, strict=True):
        assert report["retargeted_clips"] == report["evaluated_clips"] == report["tasks"] == 1, name
        assert [Path(file).stem for file in report["exported"]] == [name]
        assert report["frames"] == report["retargeted_frames"] > 0
        assert report["version"]["edited"] == f"takes/{name}"
    assert [(one["version"]["tag"], one["version"]["entries"]) for one in reports] == [("v1", 2), ("v2", 3)]
