"""The demonstration, run as by a new user."""

import contextlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from tests.support.command_line import run_here
from tests.support.forked_programs import nursery

from marey_client.cli.demo import evaluation
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

pytestmark = pytest.mark.timeout(900)

SMALL: dict[str, Any] = {"speeds_m_s": (1.5,), "turn_rates_deg_s": (0.0,), "duration_s": 5.0, "replicates": 1}
"""Options of an evaluation with two trials, for runs in which its result does not matter."""


def surroundings() -> dict[str, str]:
    return {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}


@dataclass(frozen=True)
class Printed:
    """Output and error output of a run."""

    output: str
    errors: str


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Printed]:
    """The folder of a first run in a process of its own, and the output of this run."""
    folder = tmp_path_factory.mktemp("demo")
    command = ["marey_client.cli", "demo", "--data", str(folder / "data")]
    with (folder / "output").open("wb") as output, (folder / "errors").open("wb") as errors, contextlib.chdir(folder):
        process = nursery().start(
            command, surroundings(), output=output.fileno(), errors=errors.fileno(), with_stdin=False
        )
        try:
            status = process.wait()
        finally:
            process.kill()
    printed = Printed((folder / "output").read_text("utf-8"), (folder / "errors").read_text("utf-8"))
    assert status == 0, printed
    return folder, printed


def demo_again(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run the demonstration with the data of an earlier run in this process; return its report."""
    environment = surroundings() | {"MAREY_WARM_UP": "false"}
    with mock.patch.dict(os.environ, environment, clear=True), contextlib.chdir(folder):
        done = run_here(["demo", "--data", str(folder / "data"), *arguments, "--json"])
    assert done.returncode == 0, done.stdout + done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def test_the_demonstration_tells_how_good_the_motion_is_and_does_nothing_twice(
    first: tuple[Path, Printed],
) -> None:
    folder, shown = first
    text = shown.output
    assert f"ls demo --token-file {folder}/data/admin.token" in shown.errors
    sentence = text.splitlines()[0]
    assert "trajectories" in sentence
    assert "retargeted clips: those whose root moves at least 0.5 m within 1 s" in text

    again = demo_again(folder)
    assert again["evaluation"]["verdict"] == sentence
    assert again["evaluation"]["trials"] == 50
    assert 0 < again["evaluated_clips"] < again["retargeted_clips"]
    assert again["statuses"] == {"unchanged": again["files"]}
    version = again["version"]
    assert (version["dataset"], version["tag"], version["entries"]) == ("results", "v1", again["retargeted_clips"] + 1)
    assert f"{version['edited']} was smoothed on a branch and merged" in text
    assert Path(version["picture"]).read_text("utf-8").endswith("</svg>\n")
    with open(again["evaluation_report"], encoding="utf-8") as page:
        assert "</html>" in page.read()


@pytest.mark.soak
def test_a_run_with_other_files_reports_on_these_alone(
    first: tuple[Path, Printed], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = first
    shutil.copytree(folder / "data", tmp_path / "data")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "other.bvh").write_bytes(write_bvh(generate_gait(1.6, 0.4, 3.0)))
    monkeypatch.setattr(evaluation, "OPTIONS", SMALL)
    report = demo_again(tmp_path, "other")
    assert report["retargeted_clips"] == report["evaluated_clips"] == report["tasks"] == 1
    assert [Path(file).stem for file in report["exported"]] == ["other"]
    assert report["frames"] == report["retargeted_frames"] > 0
    version, before = report["version"], len(list((folder / "data" / "generated").iterdir())) + 1
    assert (version["edited"], version["tag"], version["entries"]) == ("takes/other", "v2", before + 1)
