"""Workflow of a search by example: index a project, find similar moments, and keep the index up to date."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, cast

import pytest
from tests.support.command_line import CommandLine

from marey_client.errors import BadArgument, Conflict, Invalid, NoSuchPath, NotFound, RequestFailed
from marey_client.imports import find_files
from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_motion.mirroring import mirror_clip
from marey_motion.rigs import map_joints
from marey_motion.rigs.mapping import symmetric_joints
from marey_schemas.documents.metrics import MetricIdentity, built_in_metric
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.jobs import Job

pytestmark = pytest.mark.timeout(300)


def indexed(project: ProjectHandle, *places: str) -> dict[str, int]:
    job: Job = Jobs(project.transport).wait(project.index(list(places) or "").id)
    assert job.result is not None
    return job.result


def upload(project: ProjectHandle, file: Path, collection: str) -> str:
    project.imports.upload(find_files([file]).files, ImportOptions(collection=collection))
    return next(iter(project.clips.list(path=f"{collection}/{file.stem}"))).id


def test_similar_moments_are_found_and_the_index_follows_the_project(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    (walk,) = lab.clips.list(path="walks/walk 1.5 0")
    with pytest.raises(NotFound, match="marey index lab"):
        lab.similar(walk, (30, 60))
    with pytest.raises(NotFound, match="marey index lab"):
        list(lab.clips.list(query="like('walks/walk 1.5 0:3') < 1"))
    assert run("index", "lab").stdout == "9 clips, 9 of them new, in 1 shard\n"

    table = run("similar", "lab/walks/walk 1.5 0:30-60").stdout
    assert re.search(r"walks/walk \S+ \S+ +[0-9]+-[0-9]+ +[0-9.]+-[0-9.]+ +[0-9]\.[0-9]{3}", table), table
    found = lab.similar(walk, (30, 60), leave_out="nothing")
    assert (found.moments[0].path, found.moments[0].frames) == ("walks/walk 1.5 0", (30, 60))
    assert found.moments[0].distance == 0.0
    assert (found.searched_clips, found.behind) == (9, 0)
    others = lab.similar(walk, (30, 60))
    own = [one.frames[0] for one in others.moments if one.clip == walk.id]
    assert own
    assert all(abs(first - 30) >= 30 for first in own), "the example's own surroundings are left out"
    assert all(one.clip != walk.id for one in lab.similar(walk, 45, leave_out="clip").moments)

    # The same comparison is a condition of queries, beside others.
    moments = lab.similar(walk, (30, 60), results=100, leave_out="clip").moments
    nearest = {one.path: one.distance for one in reversed(moments)}
    limit = (sorted(nearest.values())[2] + sorted(nearest.values())[3]) / 2
    alike = sorted(path for path, distance in nearest.items() if distance < limit)
    condition = f'like("walks/walk 1.5 0:30-60") < {limit:.6f}'
    assert len(alike) == 3
    assert sorted(one.path for one in lab.clips.list(query=condition)) == sorted([walk.path, *alike])
    rest = {one.path for one in lab.clips.list(query=f"not {condition} and frames > 0")}
    assert rest == {one.path for one in lab.clips.list()} - {walk.path, *alike}
    assert "walk 1.5 0" in run("ls", "lab", "--query", condition).stdout
    for query, reason in (
        ('like("walks/none:1") < 1', "column 1: There is no clip 'walks/none'"),
        ('like("walks/walk 1.5 0:1", metrics/none) < 1', "There is no metric 'metrics/none'"),
        ('like("walks/walk 1.5 0:0-999") < 1', "ends at frame 999"),
    ):
        assert reason in run("ls", "lab", "--query", query, status=1).stderr
    with pytest.raises(RequestFailed, match="only lists of clips accept it"):
        list(lab.clips.list(query=condition, deleted=True))

    # Stored metrics measure like built-in ones, and the answer names them.
    run("metric", "store", "published/angles-manhattan", "lab/metrics/paper")
    stored = lab.similar(walk, (30, 60), metric=next(iter(lab.metrics.list())))
    assert stored == lab.similar(walk, (30, 60), metric="published/angles-manhattan")
    assert stored.metric == MetricIdentity.of(built_in_metric("published/angles-manhattan"))
    by_stored = run("similar", "lab/walks/walk 1.5 0:30-60", "--metric", "lab/metrics/paper").stdout
    assert "metric: published/angles-manhattan" in by_stored
    by_name, by_path = (
        sorted(one.path for one in lab.clips.list(query=f'like("walks/walk 1.5 0:30-60", {metric}) < 1.2'))
        for metric in ("published/angles-manhattan", "metrics/paper")
    )
    assert by_name == by_path
    document = built_in_metric("uniform/manhattan").model_copy(update={"root_alignment": "kovar2d"})
    superposing = lab.metrics.store(document, "superposing")
    with pytest.raises(Invalid, match="so use a metric with root_alignment mean_heading"):
        lab.similar(walk, (30, 60), metric=superposing)
    with pytest.raises(Invalid, match="no built-in metric 'published/none'"):
        lab.similar(walk, (30, 60), metric="published/none")
    with pytest.raises(BadArgument, match="metric: give a MetricHandle, a str or None"):
        lab.similar(walk, (30, 60), metric=cast(Any, walk))

    # A mirrored copy of the walk: only a mirrored search sees that it is the same.
    clip = generate_gait(1.9, 0.5, 3.0)
    (tmp_path / "left.bvh").write_bytes(write_bvh(clip))
    partners = symmetric_joints(clip.skeleton, map_joints(clip.skeleton))
    (tmp_path / "right.bvh").write_bytes(write_bvh(mirror_clip(clip, partners)))
    left, right = (upload(lab, tmp_path / f"{name}.bvh", "turns") for name in ("left", "right"))
    assert lab.similar(left, (60, 90)).behind == 2
    with pytest.raises(Conflict, match=r"2 clips changed or were created since .*marey index lab"):
        list(lab.clips.list(query=condition))
    told = indexed(lab)
    assert (told["clips"], told["new_clips"], told["written_shards"]) == (11, 2, 1)
    plain = {one.clip: one for one in lab.similar(left, (60, 90), leave_out="clip").moments}
    mirrored = lab.similar(left, (60, 90), leave_out="clip", mirrored=True).moments[0]
    assert (mirrored.clip, mirrored.mirrored, mirrored.frames) == (right, True, (60, 90))
    assert mirrored.distance < 0.05 < min(one.distance for one in plain.values())

    # Deleted and changed clips never appear, with or without an update of the index.
    lab.clips.get(right).delete()
    assert right not in {one.clip for one in lab.similar(left, (60, 90), mirrored=True, results=100).moments}
    motion = walk.part("motion")
    walk.put_part("motion", {**motion, "poses": motion["poses"][:60].copy()})
    answer = json.loads(run("similar", "lab/turns/left:60-90", "--results", "100", "--json").stdout)
    assert walk.id not in {one["clip"] for one in answer["moments"]}
    assert (answer["searched_clips"], answer["behind"]) == (9, 1)
    assert "1 clip changed since" in run("similar", "lab/turns/left:60-90").stderr
    assert indexed(lab)["new_clips"] == 1
    before = lab.similar(left, (60, 90), results=100, mirrored=True)
    (index,) = lab.items(Kind.INDEX).list()
    index.delete()
    assert indexed(lab)["new_clips"] == 10
    after = lab.similar(left, (60, 90), results=100, mirrored=True)
    assert (before.moments, before.behind) == (after.moments, 0), "an update gives the result of a rebuild"

    # An index of some folders cannot decide conditions for the other clips.
    run("index", "lab/turns")
    with pytest.raises(Conflict, match=r"has 1 of the 10 clips of the project.*`marey index lab`"):
        list(lab.clips.list(query='like("turns/left:60-90") < 1'))


def test_wrong_examples_are_refused_with_the_reason(lab: ProjectHandle, run: CommandLine) -> None:
    indexed(lab)
    assert "ends at frame 1000" in run("similar", "lab/walks/walk 1.5 0:0-1000", status=1).stderr
    assert "names no frames" in run("similar", "lab/walks/walk 1.5 0", status=2).stderr
    assert "after the start" in run("similar", "lab/walks/walk 1.5 0:60-60", status=2).stderr
    (index,) = lab.items(Kind.INDEX).list()
    moment = "lab/walks/walk 1.5 0:30-60"
    found = run("similar", moment).stdout
    for named in (index.id, f"lab/{index.id}", f"lab/{index.path}"):
        assert run("similar", moment, "--index", named).stdout == found, named
    assert "there is no index at lab/walks" in run("similar", moment, "--index", "lab/walks/none", status=2).stderr
    assert "is in the project other" in run("similar", moment, "--index", f"other/{index.path}", status=2).stderr
    (walk,) = lab.clips.list(path="walks/walk 1.5 0")
    with pytest.raises(RequestFailed, match="at most 100"):
        lab.transport.send(
            "POST", "/projects/lab/similar",
            content=json.dumps({"clip": walk.id, "frames": [0, 9], "results": 101}).encode(),
        )  # fmt: skip
    for clip in lab.clips.list(collection="walks"):
        if clip.id != walk.id:
            clip.delete()
    assert lab.similar(walk, (0, 9), leave_out="clip").moments == ()
    with pytest.raises(NoSuchPath):
        lab.similar("clip_00000000000000000000000000", (0, 9))
