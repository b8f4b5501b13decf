"""Search for the first version of a dataset with a bad metric, with command line and SDK, on a real server."""

from __future__ import annotations

import json
import re
import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import write_walks
from tests.support.patience import PATIENCE_S

from marey_client import Marey
from marey_client.errors import CannotBisect
from marey_client.handles.crossings import Limit
from marey_client.handles.versions import DatasetHandle
from marey_client.project import ProjectHandle
from marey_schemas.datasets.commits import Commit, EntryChange, MoveEntry, RemoveEntry
from marey_schemas.items import LOOP_TAG
from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import DatasetInput, JobState

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "evaluate.md"
_, SECTION = PAGE.read_text(encoding="utf-8").split("## Find the version of a dataset that made the result worse")
SECTION = SECTION.partition("\n## ")[0]
GRID: dict[str, Any] = {"speeds_m_s": (1.0,), "turn_rates_deg_s": (-50.0, 50.0), "duration_s": 3.0, "baseline": False}
"""Grid of an evaluation with four trials, two for each direction of turn."""
WORDS = ("--speeds", "1", "--turns=-50,50", "--duration", "3", "--no-baseline")
"""The options of `GRID` on the command line."""
BISECT_WITHOUT_LIMIT = ("dataset", "bisect", "lab/gaits", "--good", "v1", "--metric", "offset_mean_m", *WORDS)
BISECT = (*BISECT_WITHOUT_LIMIT, "--half-way")
LONG = ("--speeds", "1:3:0.5", "--duration", "20", "--replicates", "3")
"""Options that make an evaluation take so long that it can be interrupted."""
LEFT_TURNS = [f"raw/walk {speed} 60" for speed in ("1", "1.5", "2")]


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project whose dataset `gaits` has the nine walks of `gaits/raw` in its only version, `v1`."""
    project = lab_of(write_walks(tmp_path / "takes", 3.0), collection="gaits/raw")
    gaits = project.datasets.create("gaits", collection="gaits")
    gaits.commit("All walks")
    gaits.create_tag("v1")
    return project


@pytest.fixture
def gaits(lab: ProjectHandle) -> DatasetHandle:
    return lab.datasets.at("gaits")


def removed(*paths: str) -> list[EntryChange]:
    return [RemoveEntry(path=path, kind=Kind.CLIP) for path in paths]


def moved(place: str, to: str) -> list[EntryChange]:
    return [MoveEntry(path=place, kind=Kind.CLIP, to=to)]


def spoil(gaits: DatasetHandle) -> Commit:
    """Record six more versions; return the third of them, which removes the left turns and so makes the metric bad."""
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))
    gaits.commit("Rename it again", changes=moved("raw/slow", "raw/slowest"))
    spoiled = gaits.commit("Drop the left turns", changes=removed(*LEFT_TURNS))
    gaits.commit("Rename the fast walk", changes=moved("raw/walk 2 0", "raw/fast"))
    gaits.commit("Rename it again", changes=moved("raw/fast", "raw/fastest"))
    gaits.commit("Drop the fast walk", changes=removed("raw/fastest"))
    return spoiled


def short(commit: Commit) -> str:
    return commit.digest.partition(":")[2][:12]


@pytest.mark.soak
def test_the_version_that_spoiled_the_offset_is_named(
    lab: ProjectHandle, gaits: DatasetHandle, run: CommandLine
) -> None:
    spoiled = spoil(gaits)
    before = gaits.at(spoiled.parents[0])
    preview = run(*BISECT, "--preview")
    assert "6 versions can be the first bad one; about 5 evaluations" in preview.stderr
    assert "Drop the left turns" in preview.stdout
    assert list(lab.jobs()) == []

    done = run(*BISECT)
    assert done.stdout.splitlines()[0].split() == ["first", "bad", "version", short(spoiled)]
    assert "Drop the left turns" in done.stdout
    assert re.search(rf"parent {short(before)}  0\.\d+, change \+0\.\d+, 95 % interval \+\S+ to \+\S+", done.stdout)
    assert "this is one crossing" in done.stderr
    assert "noise" not in done.stderr
    made = {one.path for one in lab.evaluations.list()}
    assert f"gaits-bisect/{short(spoiled)}" in made
    assert 4 <= len(made) <= 5
    assert f"{len(made)} evaluations, 0 of them reused; 5 were expected" in done.stderr

    again = json.loads(run(*BISECT, "--json").stdout)
    assert again["first_bad"]["digest"] == spoiled.digest
    assert all(one["reused"] for one in again["evaluations"])
    found = lab.evaluations.get(again["evaluations"][0]["evaluation"]["item"])
    assert found.summary()["offset_mean_m"] == again["evaluations"][0]["value"]


def test_the_commands_and_the_program_of_the_page_find_the_version(
    gaits: DatasetHandle, run: CommandLine, marey: Marey, capsys: pytest.CaptureFixture[str]
) -> None:
    spoiled = spoil(gaits)
    commands, program = re.findall(r"```(?:sh|python)\n(.*?)```", SECTION, re.DOTALL)
    preview, *searches = [run(*shlex.split(line)[1:], *WORDS) for line in commands.splitlines()]
    assert "6 versions can be the first bad one" in preview.stderr
    for done in searches:
        assert done.stdout.splitlines()[0].split()[-1] == short(spoiled)
    exec(program, {"marey": marey})
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("Drop the left turns [(0.")
    assert told[1] == "Drop the left turns"


@pytest.mark.soak
def test_versions_of_clips_that_were_deleted_since_are_evaluated(
    lab: ProjectHandle, gaits: DatasetHandle, run: CommandLine
) -> None:
    for clip in lab.clips.list():
        if clip.path.removeprefix("gaits/") in LEFT_TURNS:
            run("rm", f"lab/{clip.path}")
    spoiled = gaits.commit("Drop the left turns")
    found = lab.bisect("gaits", "v1", metric="offset_mean_m", **GRID)
    assert found.first_bad == spoiled


@pytest.mark.soak
def test_clips_are_loops_in_the_versions_that_have_their_tag(
    lab: ProjectHandle, gaits: DatasetHandle, run: CommandLine
) -> None:
    (clip,) = lab.clips.list(path="gaits/raw/walk 1 0")
    run("tag", f"lab/{clip.path}", "--add", LOOP_TAG)
    gaits.commit("Mark the loop")
    loops = {}
    for version in ("v1", "main"):
        clips = DatasetInput(dataset="gaits", version=version)
        found = lab.evaluation(lab.evaluate(clips, name=version, database={"end_policy": "loop"}, report=False, **GRID))
        loops[version] = [one["clip"] for one in found.clips() if one["loop"]]
    assert loops == {"v1": [], "main": [clip.path]}


@pytest.mark.soak
def test_a_merged_branch_is_searched_unless_only_first_parents_are_followed(
    lab: ProjectHandle, gaits: DatasetHandle
) -> None:
    gaits.create_branch("trial", "v1")
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))
    spoiled = gaits.commit("Drop the left turns", branch="trial", changes=removed(*LEFT_TURNS))
    gaits.commit("Rename the fast walk", branch="trial", changes=moved("raw/walk 2 0", "raw/fast"))
    merged = gaits.merge("trial").commit
    assert merged is not None
    found = lab.bisect("gaits", "v1", metric="clips", limit=Limit(8, above=False), **GRID)
    assert found.first_bad == spoiled
    assert found.changes[0].interval is None
    found = lab.bisect("gaits", "v1", metric="clips", limit=Limit(8, above=False), first_parent=True, **GRID)
    assert found.first_bad == merged
    assert [one.parent.value for one in found.changes] == [9.0]
    with pytest.raises(CannotBisect, match="without the restriction to first parents, it may be found"):
        lab.bisect("gaits", spoiled.digest, metric="clips", first_parent=True, **GRID)


@pytest.mark.soak
def test_versions_that_cannot_be_evaluated_are_skipped(gaits: DatasetHandle, run: CommandLine) -> None:
    clips = [one.path for one in gaits.entries("v1") if one.kind is Kind.CLIP]
    gone = [gaits.commit("Move all clips away", changes=[one for path in clips for one in moved(path, f"away/{path}")])]
    gone.append(gaits.commit("Drop the left turns", changes=removed(*(f"away/{path}" for path in LEFT_TURNS))))
    left = [path for path in clips if path not in LEFT_TURNS]
    back = gaits.commit("Move them back", changes=[one for path in left for one in moved(f"away/{path}", path)])
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))

    done = run(*BISECT, "--path", "raw", status=1)
    rows = [line.split()[0] for line in done.stdout.splitlines()[2:] if line.strip()]
    assert [row for row in rows if re.fullmatch("[0-9a-f]{12}", row)] == [short(one) for one in (*gone, back)]
    assert done.stdout.count("The version has no clip at 'raw' or below it.") == 2
    assert "skipped: " in done.stderr


@pytest.mark.soak
def test_an_interrupted_search_is_continued_by_the_same_command(
    lab: ProjectHandle, gaits: DatasetHandle, run: CommandLine, marey: Marey
) -> None:
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))
    spoiled = gaits.commit("Drop the left turns", changes=removed(*LEFT_TURNS))
    process = run.start(*BISECT, *LONG)
    assert process.stderr is not None
    for line in process.stderr:
        if " is bad: " in line:
            break
    running = wait_for_job(lab)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "the same command continues the search and reuses the 2 evaluations made so far" in told
    assert marey.jobs.wait(running, require_success=False).state is JobState.CANCELLED

    done = run(*BISECT, *LONG)
    assert short(spoiled) in done.stdout
    assert done.stderr.count("(reused)") == 2


def wait_for_job(lab: ProjectHandle) -> str:
    """Wait until the third evaluation has been submitted, and return the id of its job."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        jobs = list(lab.jobs())
        if len(jobs) == 3:
            return jobs[0].id
        time.sleep(0.1)
    raise AssertionError("the third evaluation was not submitted")


@pytest.mark.soak
def test_ends_that_do_not_fit_are_refused_with_their_values(gaits: DatasetHandle, run: CommandLine) -> None:
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))
    assert "no value is half-way between them" in run(*BISECT, status=1).stderr
    told = run(*BISECT_WITHOUT_LIMIT, "--above", "0", status=1).stderr
    assert re.search(
        r"offset_mean_m is 0\.\d+ at the good version and 0\.\d+ at the bad one; values above 0 are bad", told
    )
    told = run(*BISECT_WITHOUT_LIMIT, "--above", "9", status=1).stderr
    assert "values above 9 are bad, so both versions are good" in told
    told = run(*BISECT, "--path", "none", status=1).stderr
    assert re.search(r"the good version, sha256:\w+, cannot be evaluated: .*The version has no clip at 'none'", told)


def test_wrong_options_are_refused_before_anything_is_evaluated(
    lab: ProjectHandle, gaits: DatasetHandle, run: CommandLine
) -> None:
    gaits.commit("Rename a walk", changes=moved("raw/walk 1 0", "raw/slow"))
    words = ("dataset", "bisect", "lab/gaits", "--good", "v1", "--half-way")
    told = run(*words, "--metric", "offset", status=1).stderr
    assert "evaluations have no metric 'offset'; their metrics are clips, unused_clips" in told
    assert "one of --above, --below and --half-way" in run(*BISECT_WITHOUT_LIMIT, status=2).stderr
    assert "one of --above, --below and --half-way" in run(*BISECT, "--above", "1", status=2).stderr
    assert "are the same version" in run(*BISECT, "--bad", "v1", status=1).stderr
    swapped = ("dataset", "bisect", "lab/gaits", "--good", "main", "--bad", "v1", "--half-way", "--metric", "clips")
    assert "the good version, main, is not among the versions before the bad one, v1" in run(*swapped, status=1).stderr
    assert list(lab.jobs()) == []


@pytest.mark.soak
def test_a_change_within_its_interval_is_called_possible_noise(gaits: DatasetHandle, run: CommandLine) -> None:
    spoiled = spoil(gaits)
    # At 1.3 m/s, the fast walk is used by some replicates only.
    others = {"v1": spoiled.digest, "offset_mean_m": "transitions_per_s", "1": "1.3"}
    done = run(*(others.get(word, word) for word in BISECT))
    assert "Drop the fast walk" in done.stdout
    assert re.search(r"95 % interval -\S+ to [+-]\S+", done.stdout)
    assert re.search(r"change from [0-9a-f]{12} contains 0, so the crossing may be noise", done.stderr)


def test_any_test_of_versions_can_be_searched_with(gaits: DatasetHandle) -> None:
    spoiled = spoil(gaits)
    found = gaits.bisect("v1", "main", lambda commit: commit.entries < 9)
    assert found.first_bad == spoiled
    assert len(found.tests) <= 2 + found.range.expected_tests
