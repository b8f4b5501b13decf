"""Workflow from takes to single steps: propose, correct and cut, on a real server with a real worker."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present

from marey_client.errors import JobUnsuccessful, PreconditionFailed, RequestFailed
from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_schemas.queue.jobs import Job

pytestmark = pytest.mark.timeout(300)


def done(project: ProjectHandle, job: Job) -> Job:
    return Jobs(project.transport).wait(job.id)


def test_walks_become_steps_of_each_foot_with_their_keyframes(lab: ProjectHandle) -> None:
    told = done(lab, lab.annotate("walks")).result
    assert told is not None
    assert told["annotations"] == 9
    assert told["segments"]["step_left"] >= 9 <= told["segments"]["step_right"]
    found = list(lab.annotations.list(collection="walks"))
    assert {one.document().made_by for one in found} == {"algorithm"}

    made = done(lab, lab.cut("walks", into="steps", labels=("step_left", "step_right"), by_label=True)).result
    assert made is not None
    steps = list(lab.clips.list(collection="steps/walks/step_left"))
    assert len(steps) == made["labels"]["step_left"] == told["segments"]["step_left"]
    assert list(lab.clips.list(collection="steps/walks/step_right"))

    step = next(one for one in steps if one.name == "walk 1.5 0_step_left_01")
    (source,) = lab.clips.list(path="walks/walk 1.5 0")
    frames = present(step.info().source).details["frames"]
    np.testing.assert_array_equal(step.motion().poses, source.motion(frames=slice(*frames)).poses)
    (said,) = step.annotations()
    assert [keyframe.label for keyframe in said.document().keyframes] == ["passing"]
    assert {edge.kind.value for edge in step.lineage().inputs} == {"annotation", "clip"}


def test_pieces_are_of_the_clip_as_it_was_annotated(lab: ProjectHandle) -> None:
    (clip,) = lab.clips.list(path="walks/walk 1 0")
    said = clip.annotate("parts", segments=[{"label": "middle", "start": 60, "end": 120}])
    before = clip.motion().poses
    motion = clip.part("motion")
    clip.put_part("motion", {**motion, "poses": np.ascontiguousarray(motion["poses"][::-1])})
    done(lab, lab.cut(said, into="pieces", margin_before_s=0.25))
    (piece,) = lab.clips.list(collection="pieces")
    np.testing.assert_array_equal(piece.motion().poses, before[45:120])
    (of_piece,) = piece.annotations()
    assert of_piece.document().segments[0].model_dump() == {"label": "middle", "start": 15, "end": 75}
    assert [edge.name for edge in piece.staleness().because] == ["walk 1 0"]


def test_commands_are_carried_out_together_or_not_at_all(lab: ProjectHandle) -> None:
    (clip,) = lab.clips.list(path="walks/walk 1 0")
    said = clip.annotate("parts")
    said.apply(
        [
            {"command": "create_segment", "label": "a", "start": 0, "end": 100},
            {"command": "split_segment", "at": 40, "label": "b"},
            {"command": "add_keyframe", "label": "middle", "frame": 50},
        ],
        message="First cut",
    )
    assert said.item.revision == 2
    assert [(one.label, one.start, one.end) for one in said.document().segments] == [("a", 0, 40), ("b", 40, 100)]
    with pytest.raises(RequestFailed) as refused:
        said.apply([{"command": "clear"}, {"command": "remove_segment", "at": 5}])
    assert refused.value.status == 422
    assert refused.value.problem.errors[0].pointer == "/commands/1"
    assert refused.value.problem.errors[0].code == "no-segment"
    assert len(said.document().segments) == 2

    other = lab.annotations.get(said.id)
    other.apply([{"command": "relabel_segment", "at": 0, "label": "c"}])
    with pytest.raises(PreconditionFailed):
        said.apply([{"command": "clear"}])
    assert [one.id for one in clip.annotations()] == [said.id]


def test_two_pieces_of_one_name_are_refused_before_any_is_made(lab: ProjectHandle) -> None:
    (clip,) = lab.clips.list(path="walks/walk 1 0")
    for layer in ("mine", "yours"):
        clip.annotate(layer, segments=[{"label": "a", "start": 0, "end": 60}])
    with pytest.raises(JobUnsuccessful, match=r"same-name.*2 pieces would have the path walks/walk 1 0_a_01"):
        done(lab, lab.cut("walks", into="pieces"))
    assert not list(lab.clips.list(collection="pieces"))
    done(lab, lab.cut("walks", into="pieces", layer="mine"))
    assert len(list(lab.clips.list(collection="pieces"))) == 1


def test_annotations_are_made_corrected_and_exchanged_from_the_command_line(
    lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    clip, place = "lab/walks/walk 1 0", "lab/walks/walk 1 0 parts"
    told = run("annotation", "create", clip, "--layer", "parts", "--segment", "b=50:90", "--segment", "a=0:50")
    assert told.stdout.strip() == place
    run("annotation", "split", place, 20, "--label", "c")
    run("annotation", "move", place, 60, "--end", 100)
    run("annotation", "keyframe", place, "middle", 70)
    run("annotation", "keyframe", place, "middle", 70, "--move", 75)
    run("annotation", "add", place, "d", "100:110")
    run("annotation", "merge", place, 105, "--with", "previous")
    run("annotation", "relabel", place, 105, "e")
    assert "revision 9, 2 segments, 1 keyframe\n" in run("annotation", "remove", place, 0).stdout
    shown = run("annotation", "show", place).stdout
    assert "middle" in shown
    document = json.loads(run("annotation", "show", place, "--json").stdout)
    assert document["segments"] == [
        {"label": "c", "start": 20, "end": 50},
        {"label": "e", "start": 50, "end": 110},
    ]
    refused = run("annotation", "split", place, 300, status=1)
    assert "frame 300: no segment contains this frame" in refused.stderr

    file = run("annotation", "export", place, "-o", "out", "--end-index", "exclusive").stdout.strip()
    written = json.loads((tmp_path / file).read_text(encoding="utf-8"))
    assert written["sections"] == {"c": [{"start_idx": 20, "end_idx": 50}], "e": [{"start_idx": 50, "end_idx": 110}]}
    again = run("annotation", "import", clip, file, "--end-index", "exclusive", "--layer", "again").stdout.strip()
    imported = json.loads(run("annotation", "show", again, "--json").stdout)
    assert (imported["segments"], imported["keyframes"]) == (document["segments"], document["keyframes"])
    assert "exclusive" in run("annotation", "import", clip, file, "--layer", "inclusive", status=1).stderr

    assert "2 clips, 1 c, 1 e" in run("cut", place, "--into", "pieces", "--before", 0.1).stdout
    assert "annotations" in run("annotation", "propose", "lab/walks", "--set", "most_turn_deg=20").stdout
    assert "most_turn" in run("annotation", "propose", "lab/walks", "--set", "most_turn=20", status=2).stderr
