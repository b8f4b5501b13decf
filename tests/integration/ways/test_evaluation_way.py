"""Workflow of an evaluation, with command line and SDK, on a real server with a real worker."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.support.command_line import CommandLine

from marey_client.errors import JobUnsuccessful
from marey_client.handles.evaluations import name_of_trial, worst_rows_first
from marey_client.imports import find_files
from marey_client.poses.player_pages import ShownMotion
from marey_client.poses.trials import motions_of_worst_trials
from marey_client.project import ProjectHandle
from marey_motion import forward_directions, forward_kinematics
from marey_motion.clip import Clip
from marey_motion.documents import skeleton_from_document
from marey_motion.evaluation.result_documents import trial_from_document
from marey_motion.evaluation.scenario import demand
from marey_motion.formats import write_bvh
from marey_motion.gait import game_skeleton, generate_gait
from marey_reports.drawing.stick_figures import body_of
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.items import ItemChange
from marey_schemas.options.imports import ImportOptions
from marey_schemas.wording import counted

pytestmark = pytest.mark.timeout(300)

SMALL: dict[str, Any] = {
    "speeds_m_s": (1.0, 2.0),
    "turn_rates_deg_s": (-50.0, 0.0, 50.0),
    "duration_s": 4.0,
    "replicates": 1,
    "report": False,
}
"""12 trials in 2 tasks."""


def test_from_a_folder_of_clips_to_a_verdict_and_a_report(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    grid = ("--speeds", "1:2:1", "--turns=-50:50:50", "--duration", "4", "--replicates", 3)
    told = run("evaluate", "lab/walks", *grid, "--out", "report.html").stdout
    (found,) = lab.evaluations.list()
    assert found.path == "walks-eval"
    assert found.verdict in told
    assert "circle v=" in told or "switching v=" in told
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")
    assert "walk 1.5 60" in page

    used = list(lab.clips.list(query="facet.usage > 0 and folder = walks", sort="name"))
    assert sum(one.item.facets["usage"] for one in used) == pytest.approx(1)
    listed = run("ls", "lab/walks", "--query", "facet.usage > 0", "--columns", "facet.usage", "--sort=-facet.usage")
    shown = [float(line.split()[-1]) for line in listed.stdout.splitlines() if "walks/walk" in line]
    assert shown == pytest.approx(sorted((one.item.facets["usage"] for one in used), reverse=True), rel=1e-3)
    usage = f"{used[0].item.facets['usage']:.6g}"
    assert re.search(rf"facet\.usage +{re.escape(usage)}\n", run("show", f"lab/{used[0].path}").stdout)

    again = json.loads(run("evaluate", "lab/walks", *grid, "--json").stdout)
    assert again["evaluation"]["revision"] == 1
    assert len(again["trials"]) == again["summary"]["trials"] == 12

    run("report", "lab/walks-eval", "--out", "again.html", "--figures", "figures")
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == page
    assert (tmp_path / "figures" / "offsets.png").read_bytes().startswith(b"\x89PNG")

    run("view", "lab/walks-eval", "-n", 2, "--moments", 4, "--out", "worst.svg")
    drawn = (tmp_path / "worst.svg").read_text(encoding="utf-8")
    ranked = sorted(found.document()["trials"], key=lambda one: one["worst_rank"])
    worst = [name_of_trial(one["trial"]) for one in ranked]
    demands = [demand(trial_from_document(one["trial"])) for one in ranked]
    beyond = [f"{counted(len(one['beyond_limits']), 'measure')} beyond limits" for one in ranked]
    texts = " ".join(re.findall(r">([^<>\n]+)</text>", drawn))  # in which a long label has several lines
    assert [texts.count(f"{one} {limits}") for one, limits in zip(demands, beyond, strict=True)][:3] == [1, 1, 0]
    assert drawn.count(">after<") == 4
    played = motions_of_worst_trials(found, None, 2)
    assert [one.name for one in played] == demands[:2]
    for one, trial in zip(played, worst, strict=False):
        _assert_follows(one, found.records()[trial])
    assert (
        "no effect on a model or an evaluation"
        in run("view", "lab/walks-eval", "--out", "x.svg", "--beside", "source", status=2).stderr
    )
    assert "again.html" in {path.name for path in tmp_path.iterdir()}

    run("report", "lab/walks-eval", "--walk-graph", "walks.graphml")
    trial = found.trials()[0]["trial"]
    run("report", "lab/walks-eval", "--walk-graph", "one.json", "--trial", trial)
    nodes = ElementTree.parse(tmp_path / "walks.graphml").iter("{http://graphml.graphdrawing.org/xmlns}node")
    assert len(list(nodes)) == len(found.walk_graph()["nodes"]["ticks"])
    assert json.loads((tmp_path / "one.json").read_bytes()) == found.walk_graph(trial=trial)
    with pytest.raises(ValueError, match=r"\.json or \.graphml"):
        found.save_walk_graph(tmp_path / "walks.dot")


def _assert_follows(shown: ShownMotion, record: dict[str, Any]) -> None:
    """Assert that the pelvis of a shown trial has the recorded positions, and its body the recorded headings."""
    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(shown.hierarchy))
    facing, pelvis = body_of(skeleton).facing, body_of(skeleton).pelvis
    moved = tuple(skeleton.index_of(name) for name in shown.motion.translated_joints)
    points = forward_kinematics(
        skeleton, shown.motion.poses, translations=shown.motion.translations, translated_joints=moved
    )
    assert points[:, pelvis, ::2] == pytest.approx(record["positions"], abs=1e-4)
    ahead = forward_directions(points, *facing)
    turned = np.stack((np.sin(record["headings"]), np.cos(record["headings"])), axis=1)
    assert ahead == pytest.approx(turned, abs=1e-3)
    assert shown.motion.frame_rate_hz * len(shown.motion.poses) >= 30


def test_worst_trials_are_shown_with_the_translations_of_their_joints(lab: ProjectHandle, tmp_path: Path) -> None:
    gait = generate_gait(speed_m_s=1.9, turn_rate_rad_s=0.0, duration_s=6.0)
    sway = gait.skeleton.offsets[1] + np.sin(np.arange(gait.frame_count) / 5.0)[:, None] * (0.0, 0.02, 0.0)
    swaying = replace(gait, translations=sway[:, None].astype(np.float32), translated_joints=(1,))
    (tmp_path / "swaying.bvh").write_bytes(write_bvh(swaying))
    lab.imports.upload(find_files([tmp_path / "swaying.bvh"]).files, ImportOptions(collection="walks"))
    found = lab.evaluation(lab.evaluate("walks", **SMALL))
    played = motions_of_worst_trials(found, None, 12)
    for one, trial in zip(played, worst_rows_first(found.trials()), strict=True):
        _assert_follows(one, found.records()[trial["trial"]])
    sways = [np.ptp(one.motion.translations[:, 0, 1]) for one in played if one.motion.translations is not None]
    assert max(sways) == pytest.approx(0.04, abs=0.005)


def test_an_evaluation_holds_every_tick_and_knows_every_clip(lab: ProjectHandle) -> None:
    found = lab.evaluation(lab.evaluate("walks", name="small", into="results", tags=("nightly",), **SMALL))
    assert (found.path, found.item.tags) == ("results/small", ("nightly",))
    trials, clips, records = found.trials(), found.clips(), found.records()
    assert [trial["trial"] for trial in trials] == list(records)
    assert {clip["clip"] for clip in clips} == {clip.path for clip in lab.clips.list()}
    ticks = round((3.0 + SMALL["duration_s"]) * 60)
    for record in records.values():
        assert record["positions"].shape == (ticks, 2)
        assert np.isfinite(record["pose_cost"]).any()
    assert sum(clip["ticks"] for clip in clips) == ticks * len(trials)
    assert {edge.item for edge in found.lineage().inputs} == {clip.id for clip in lab.clips.list()}
    assert not found.staleness().stale


def test_clips_of_two_skeletons_are_refused_by_name(lab: ProjectHandle, tmp_path: Path) -> None:
    skeleton = game_skeleton()
    at_rest = np.concatenate([skeleton.offsets[0], skeleton.rest_rotations.ravel()]).astype(np.float32)
    (tmp_path / "stranger.bvh").write_bytes(write_bvh(Clip(skeleton, 30.0, np.tile(at_rest, (60, 1)), None, ())))
    lab.imports.upload(find_files([tmp_path / "stranger.bvh"]).files, ImportOptions(collection="walks"))
    with pytest.raises(JobUnsuccessful, match=r"but walks/stranger do not; .*marey retarget"):
        lab.evaluation(lab.evaluate("walks", **SMALL))
    assert list(lab.evaluations.list()) == []


def test_clips_tagged_as_loops_are_looped_and_frames_can_be_trimmed(lab: ProjectHandle) -> None:
    first, second, *_ = sorted(lab.clips.list(), key=lambda clip: clip.path)
    first.change(ItemChange(tags=("loop",)))
    options: dict[str, Any] = {
        **SMALL,
        "database": {"end_policy": "loop"},
        "trims": {second.id: (30, 90)},
        "baseline": False,
    }
    found = lab.evaluation(lab.evaluate("walks", **options))
    clips = {clip["clip"]: clip for clip in found.clips()}
    assert [name for name, clip in clips.items() if clip["loop"]] == [first.path]
    rate_hz = second.item.summary["frame_rate_hz"]
    assert clips[second.path]["frames"] == pytest.approx(60 * 60 / rate_hz, abs=2)
    with pytest.raises(JobUnsuccessful, match="the range of frames 30:9999 is outside the clip"):
        lab.evaluation(lab.evaluate("walks", **(options | {"trims": {second.id: (30, 9999)}})))


def test_the_normaliser_of_another_evaluation_can_be_used(lab: ProjectHandle) -> None:
    first = lab.evaluation(lab.evaluate("walks", name="all", **SMALL))
    some = sorted(lab.clips.list(), key=lambda clip: clip.path)[:6]
    own = lab.evaluation(lab.evaluate(some, name="own", **SMALL))
    pinned = lab.evaluation(lab.evaluate(some, name="pinned", normaliser=first, **SMALL))
    scales = [found.document()["provenance"]["normaliser"] for found in (first, own, pinned)]
    assert scales[0] == scales[2] != scales[1]
    assert first.id in {edge.item for edge in pinned.lineage().inputs}


@pytest.mark.soak
def test_courses_and_takes_are_simulated_drawn_and_compared(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    options = ("--duration", 6, "--switch-every-s", 2, "--approach", 1, "--replicates", 3, "--no-baseline")
    grid = ("--speeds", 1, "--turns", 100, "--corner-angles-deg", 90, "--strafe-angles-deg", 180)
    courses = ("--families", "stopping,corners,eights,strafing", *grid, *options)
    told = run(
        "evaluate", "lab/walks", "--name", "all", *courses, "--trial-figure", "corners v=1 a=90", "--out", "all.html"
    ).stdout
    regions = ("Stops", "Corners", "Figures of eight", "Backwards")
    assert all(f"\n{region}: " in told for region in regions), told
    (found,) = lab.evaluations.list()
    assert [one["trial"] for one in found.trials()] == [
        "stopping v=1 w=100", "corners v=1 a=90", "eights v=1 w=100", "strafing v=1 a=180",
    ]  # fmt: skip
    drawn = {figure["name"] for figure in found.part("report")["figures"] if figure["trial"] == "corners v=1 a=90"}
    assert {"scenario-course", "clip-graph"} <= drawn
    fewer = [f"lab/{clip.path}" for clip in sorted(lab.clips.list(), key=lambda clip: clip.path)[:6]]
    run("evaluate", *fewer, "--name", "fewer", *courses, "--normaliser", "lab/all", "--no-report")
    run("compare", "lab/all", "lab/walks/fewer", "--out", "compared.html")
    assert "corners of 90 degrees" in (tmp_path / "compared.html").read_text(encoding="utf-8")

    # Six clips have at most six takes, although the options allow for so many that there are seven tasks.
    told = run("evaluate", *fewer, "--name", "takes", "--families", "takes", "--most-takes", 56, *options).stdout
    assert re.search(r"^Real paths: \d of 6 trajectories followed", told, re.MULTILINE), told
    takes = next(one for one in lab.evaluations.list() if one.path == "walks/takes")
    assert sorted(f"lab/{one['trial'].removeprefix('takes ')}" for one in takes.trials()) == fewer
    refused = run("compare", "lab/walks/takes", "lab/all", status=1).stderr
    assert "evaluate both sets without the family `takes`" in refused
