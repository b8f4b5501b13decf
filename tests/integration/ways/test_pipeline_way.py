"""Workflow from takes to a model, with command line and SDK, on a real server with a real worker."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from benchmarks.pipeline_under_fire import write_takes
from tests.support.command_line import CommandLine

from marey_client import Marey
from marey_client.errors import NoAnnotations
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.formats import write_motion
from marey_motion.gait import generate_gait
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions

pytestmark = pytest.mark.timeout(600)

FEW = 6
"""Number of takes that are enough for a model."""
TAKES = 17
"""Number of takes; more than one task of a retargeting job processes."""

QUICK = (
    "model.leave_one_out=false", "model.folds=0", "model.report_samples=0", "model.report=false", "tree.samples=100"
)  # fmt: skip
QUICK_FLAGS = tuple(flag for choice in QUICK for flag in ("--set", choice))
CHANGED = "walk-003"


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path, request: pytest.FixtureRequest) -> ProjectHandle:
    """A project with one skeleton from `game.bvh`. The folder `takes` beside this file is not imported yet.

    The folder contains `FEW` takes; a parameter of the fixture is another number.
    """
    write_takes(tmp_path, getattr(request, "param", FEW))
    return lab_of(tmp_path / "game.bvh", collection="rigs")


def skeleton_path(lab: ProjectHandle) -> str:
    (rig,) = lab.skeletons.list()
    return f"lab/{rig.path}"


def attempts(marey: Marey, jobs: dict[str, Any]) -> dict[str, int]:
    """Return the number of attempts of each step, including the attempts of its tasks."""
    counts = {}
    for name, job in jobs.items():
        tasks = [one.id for one in marey.jobs.list("lab", filters={"parent": job["id"]})]
        counts[name] = sum(len(list(marey.jobs.attempts(one))) for one in (job["id"], *tasks))
    return counts


@pytest.mark.parametrize("lab", [TAKES], ids=["takes"], indirect=True)
def test_after_one_take_has_changed_the_model_is_stale_and_only_what_depends_on_that_take_is_computed_again(
    marey: Marey, lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    line = ("build-model", "takes", "--project", "lab", "--to", skeleton_path(lab), "--name", "walk", *QUICK_FLAGS)
    first = json.loads(run(*line, "--json").stdout)["jobs"]
    assert list(first) == ["import", "retarget", "align", "model", "tree"]
    assert attempts(marey, first) == {"import": 1, "retarget": 2, "align": 1, "model": 1, "tree": 1}
    (model,) = lab.items(Kind.MODEL).list()
    assert (model.path, {"model", "tree"} <= model.item.parts.keys()) == ("walk/walk", True)
    assert len(list(lab.items(Kind.PROCESSED).list(collection="walk/aligned"))) == TAKES
    assert "stale" not in run("show", "lab/walk/walk").stdout

    again = json.loads(run(*line, "--json").stdout)["jobs"]
    assert set(attempts(marey, again).values()) == {0}
    assert lab.items(Kind.MODEL).get(model.id).item.revision == model.item.revision

    changed = tmp_path / "takes" / f"{CHANGED}.bvh"
    changed.write_bytes(write_motion(generate_gait(1.4, 0.3, 1.2, 60.0), "bvh"))
    lab.imports.upload(find_files([changed]).files, ImportOptions(collection="walk/takes"))
    shown = dict(line.split(maxsplit=1) for line in run("show", "lab/walk/walk").stdout.splitlines())
    assert shown["stale"] == f"clip {CHANGED} has newer revisions than 1"
    because = lab.items(Kind.MODEL).get(model.id).staleness().because
    assert {(edge.kind, edge.name) for edge in because} == {("clip", CHANGED)}

    third = json.loads(run(*line, "--json").stdout)["jobs"]
    assert attempts(marey, third) == {"import": 1, "retarget": 1, "align": 1, "model": 1, "tree": 1}
    now = lab.items(Kind.MODEL).get(model.id)
    assert now.item.revision > model.item.revision
    assert not now.staleness().stale
    revisions = {clip.name: clip.item.revision for clip in lab.clips.list(collection="walk/retargeted")}
    assert {name for name, revision in revisions.items() if revision > 1} == {CHANGED}


def test_clips_that_are_there_become_a_model_from_python_too(lab: ProjectHandle, tmp_path: Path) -> None:
    lab.imports.upload(find_files([tmp_path / "takes"]).files, ImportOptions(collection="raw"))
    seen: list[set[str]] = []
    pipeline = lab.build_model(
        "raw", name="walk", into="models", annotate={"proposal": {"method": "steps"}}, cut={}, align={"rate_hz": 30},
        model={"leave_one_out": False, "folds": 0, "report_samples": 0, "report": False}, tree=None, priority=5,
    )  # fmt: skip
    ended = pipeline.wait(
        timeout_s=300, on_progress=lambda steps: seen.append({job.state.value for job in steps.values()})
    )
    assert list(ended) == ["annotate", "cut", "align", "model"]
    assert {job.priority for job in ended.values()} == {5}
    assert "waiting" in seen[0]
    (made,) = pipeline.outputs("model")
    assert lab.items(Kind.MODEL).get(made.item).path == "models/walk"
    pieces = {clip.item.collection for clip in lab.clips.list(collection="models/pieces")}
    assert pieces == {"models/pieces/raw"}
    with pytest.raises(NoAnnotations, match="nobody"):
        lab.build_model("raw", name="other", layer="nobody", cut={})


def test_a_graph_of_jobs_comes_from_a_file_or_from_standard_input(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    lab.imports.upload(find_files([tmp_path / "takes" / f"{CHANGED}.bvh"]).files, ImportOptions(collection="raw"))
    (rig, *_) = lab.skeletons.list(sort="id")
    skeleton = {"item": rig.id}
    steps: dict[str, Any] = {
        "once": {"kind": "retarget", "inputs": {"clips": {"collection": "raw"}, "skeleton": skeleton}, "into": "once"},
        "twice": {"kind": "retarget", "inputs": {"clips": {"step": "once"}, "skeleton": skeleton}, "into": "twice"},
    }
    (tmp_path / "graph.json").write_text(json.dumps({"steps": steps}))
    told = run("pipeline", "graph.json", "--project", "lab").stdout
    assert told.count("succeeded") == 2
    assert next(lab.clips.list(collection="twice")).path == f"twice/raw/{CHANGED}"
    again = json.loads(run("pipeline", "-", "--project", "lab", "--json", stdin=json.dumps({"steps": steps})).stdout)
    assert {job["cached_from"] is not None for job in again["jobs"].values()} == {True}

    steps["once"]["inputs"]["clips"] = {"step": "twice"}
    refused = run("pipeline", "-", "--project", "lab", stdin=json.dumps({"steps": steps}), status=1).stderr
    assert "/steps/twice/inputs/clips/step: These steps wait for each other: once -> twice -> once" in refused
    assert "JSON" in run("pipeline", "-", "--project", "lab", stdin="steps: {}", status=2).stderr


def test_takes_that_did_not_get_into_the_model_are_told_with_why(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    takes = tmp_path / "takes"
    (takes / "broken.bvh").write_bytes(b"HIERARCHY\nROOT Hips\n{\n  OFFSET 0 0 nonsense\n")
    (tmp_path / "game.bvh").rename(takes / "another body.bvh")
    ended = run("build-model", "takes", "--project", "lab", "--name", "walk", *QUICK_FLAGS, status=1)
    assert "import refused 1 input:\nbroken.bvh" in ended.stderr
    assert f"align refused 1 input:\nwalk/takes/another body: it has another skeleton than {FEW} of" in ended.stderr
    assert "which have walk/takes/skeletons/" in ended.stderr
    assert f"{FEW} examples in " in ended.stdout
    assert len(list(lab.items(Kind.PROCESSED).list(collection="walk/aligned"))) == FEW


def questions_about_jobs(run: CommandLine) -> list[str]:
    """Return the lines of the server's metrics that count requests which wait for a job."""
    lines = httpx.get(f"{run.server.url}/metrics").text.splitlines()
    return [
        line for line in lines if line.startswith('marey_http_requests_total{method="GET",route="/api/v1/jobs/{job}"')
    ]


@pytest.mark.soak
def test_who_stops_waiting_leaves_the_jobs_running_and_is_told_so(
    lab: ProjectHandle, run: CommandLine, marey: Marey
) -> None:
    asked_before = questions_about_jobs(run)
    worker = run.server.worker
    assert worker is not None
    worker.send(signal.SIGSTOP)  # the jobs cannot end before the command does
    try:
        waiting = run.start(
            "build-model", "takes", "--project", "lab", "--to", skeleton_path(lab), "--name", "walk", *QUICK_FLAGS
        )
        deadline = time.monotonic() + 120
        while questions_about_jobs(run) == asked_before:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        waiting.send_signal(signal.SIGINT)
        _, told = waiting.communicate(timeout=60)
    finally:
        worker.send(signal.SIGCONT)
    assert waiting.returncode == 130, told
    assert "continue on the server" in told
    for job in list(lab.jobs()):
        assert marey.jobs.wait(job.id, timeout_s=300).state == "succeeded"
