"""Workflow from examples of an action to aligned clips, with command line and SDK, on a real server."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.alignment_examples import warped_walks
from tests.support.command_line import CommandLine

from marey_client.errors import JobUnsuccessful
from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_motion.formats import read_motion, write_bvh
from marey_schemas.queue.jobs import Job

pytestmark = pytest.mark.timeout(300)

NAMES = ("walk a", "walk b", "walk c", "walk d", "walk e")


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with five examples of one walk, and one clip that is too short to be aligned."""
    folder = tmp_path / "takes"
    folder.mkdir()
    examples, _ = warped_walks(len(NAMES))
    for one in examples:
        (folder / f"{one.name}.bvh").write_bytes(write_bvh(one.clip))
    (folder / "blink.bvh").write_bytes(write_bvh(examples[0].clip.sliced(0, 3)))
    return lab_of(folder)


def done(project: ProjectHandle, job: Job) -> dict[str, Any]:
    result = Jobs(project.transport).wait(job.id).result
    assert result is not None
    return result


def clip_id(project: ProjectHandle, name: str) -> str:
    (found,) = project.clips.list(path=f"walks/{name}")
    return found.id


def test_clips_of_a_folder_are_aligned_listed_exported_and_traced_back(lab: ProjectHandle, tmp_path: Path) -> None:
    result = done(lab, lab.align("walks", into="aligned", reference=clip_id(lab, "walk a"), tags=("model",)))
    assert (result["clips"], result["frames"], result["reference"]) == (5, 60, "walks/walk a")
    assert [(one["name"], one["code"]) for one in result["refused"]] == [("walks/blink", "too-short")]

    made = {one.name: one for one in lab.processed.list(collection="aligned")}
    assert sorted(made) == list(NAMES)
    one = made["walk b"]
    assert one.path == "aligned/walks/walk b"
    assert one.item.tags == ("model",)
    summary = one.item.summary
    assert summary["frames"] == 60
    assert summary["clip"] == clip_id(lab, "walk b")
    assert summary["reference"] == clip_id(lab, "walk a")
    assert summary["cost"] == pytest.approx(one.info().cost)
    assert summary["set"] == result["set"]
    skeleton = summary["skeleton"]
    assert {found.id for found in lab.processed.list(filters={"skeleton": skeleton})} == {x.id for x in made.values()}

    times = one.time_function()
    source = one.source()
    assert source is not None
    assert source.name == "walk b"
    assert times[-1] == len(source.motion().poses) - 1
    assert np.diff(times).min() > 0.0
    assert len(one.motion(frames=slice(10, 20)).poses) == 10
    assert {edge.name for edge in one.lineage().inputs} == {"walk a", "walk b"}

    file = one.export(tmp_path, format="bvh")
    read = read_motion(file.read_bytes(), file.name).clip
    assert read is not None
    assert read.frame_count == 60


def test_an_aligned_clip_is_given_back_in_its_own_time_where_it_stood(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    done(lab, lab.align("walks", into="aligned"))
    run("download", "lab/aligned", "--format", "npz", "--restored", "-o", "restored")
    (source,) = lab.clips.list(path="walks/walk b")
    read = read_motion((tmp_path / "restored" / "walks" / "walk b.npz").read_bytes(), "walk b.npz").clip
    assert read is not None
    wanted = source.motion()
    assert read.frame_count == len(wanted.poses)
    np.testing.assert_allclose(read.poses[:, :3], wanted.root_translations, atol=0.02)
    assert (
        "with the timing of their source clip"
        in run("download", "lab/walks/walk b", "--format", "npz", "--restored", status=1).stderr
    )


def test_keyframes_of_annotations_are_matched_and_become_those_of_the_set(lab: ProjectHandle) -> None:
    _, warps = warped_walks(len(NAMES))
    frames = {}
    for clip in lab.clips.list(collection="walks"):
        if clip.name in NAMES:
            frames[clip.name] = int(np.argmin(np.abs(warps[f"clip_{clip.name[-1]}@1"] - 30)))
            clip.annotate("contacts", keyframes=[{"label": "down", "frame": frames[clip.name]}])
    result = done(lab, lab.align("walks", into="aligned", layer="contacts", reference=clip_id(lab, "walk a")))
    assert result["keyframes"] == {"down": 30}
    assert [one["code"] for one in result["refused"]] == ["no-annotation"]
    for made in lab.processed.list(collection="aligned"):
        assert made.info().keyframes == {"down": 30}
        assert made.time_function()[30] == frames[made.name]


def test_the_command_tells_costs_slopes_and_refusals(lab: ProjectHandle, run: CommandLine) -> None:
    told = run("align", "lab/walks", "--into", "aligned", "--reference", "lab/walks/walk c", status=1)
    assert "walks/blink: the clip has 3 frames" in told.stderr
    assert "reference" in next(line for line in told.stdout.splitlines() if "walk c" in line)
    assert "5 clips of" in told.stdout

    clips = [f"lab/walks/{name}" for name in NAMES]
    again = json.loads(run("align", *clips, "--into", "plain", "--cost", "plain", "--json").stdout)
    assert again["state"] == "succeeded"
    assert again["result"]["refused"] == []
    assert run("align", "lab/walks", "--into", "x", "--weight", "LeftFoot", status=2).stderr


def test_the_same_alignment_again_makes_no_new_revisions(lab: ProjectHandle) -> None:
    first = done(lab, lab.align("walks", into="aligned"))
    again = done(lab, lab.align("walks", into="aligned", cache="refresh"))
    assert again == first
    assert {one.item.revision for one in lab.processed.list(collection="aligned")} == {1}


def test_what_cannot_be_aligned_is_told_and_makes_nothing(lab: ProjectHandle) -> None:
    job = lab.align("walks", into="aligned", weights={"Tail": 2.0})
    with pytest.raises(JobUnsuccessful, match="Tail"):
        done(lab, job)
    assert list(lab.processed.list(collection="aligned")) == []
