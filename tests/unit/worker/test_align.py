"""The function of the job kind `align`, with a project in memory instead of a server."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.alignment_examples import walk, warped_walks
from tests.support.present import present
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion import documents
from marey_motion.alignment.aligned_documents import StoredExample, set_from_examples
from marey_motion.gait import generate_gait
from marey_motion.modelling.example_groups import ExampleGroups
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import ClipInfo, MotionDocument
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import AlignParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import JobRefused
from marey_worker.kinds import align

NAMES = ("a", "b", "c", "d")


class Project(ProjectInMemory):
    """Project in memory that records what a job logs."""

    def log(self, text: str) -> None:
        self.told.append(text)


@pytest.fixture
def project(tmp_path: Path) -> Project:
    """Four examples of one walk, of different lengths."""
    made = Project(tmp_path)
    examples, _ = warped_walks(4)
    for name, one in zip(NAMES, examples, strict=True):
        add_clip(made, name, one.clip)
    return made


def annotate(
    project: Project,
    name: str,
    *,
    layer: str = "steps",
    revision: int = 1,
    segments: tuple[Any, ...] = (),
    keyframes: tuple[Any, ...] = (),
) -> None:
    item = f"annotation_{name}_{layer}_{revision}"
    document = Annotation(
        clip={"item": f"clip_{name}", "revision": revision}, layer=layer, segments=segments, keyframes=keyframes
    )
    project.parts[item, 1, "annotation"] = document.model_dump(mode="json", by_alias=True)
    pin = PinnedInput(item=item, revision=1, kind=Kind.ANNOTATION, name=item, collection="said")
    project.inputs["annotations"] = (*project.inputs.get("annotations", ()), pin)


def keyframe(frame: int, label: str = "down") -> tuple[dict[str, Any]]:
    return ({"label": label, "frame": frame},)


def infos(project: Project) -> dict[str, AlignmentInfo]:
    return {output.item_name: AlignmentInfo.model_validate(output.parts["info"]) for output in project.staged}


def test_examples_know_their_take_and_their_performer(project: Project) -> None:
    """Pieces that were cut from one clip are of one take; a clip without records is a take of its own."""
    cut = {"format": "cut", "details": {"clip": {"item": "walk", "revision": 3}, "label": "step"}}
    for name in "ab":
        described = ClipInfo.model_validate({"subject": "02", "source": cut})
        project.parts[f"clip_{name}", 1, "info"] = described.model_dump(mode="json", by_alias=True)
    numbered = ClipInfo.model_validate({"subject": "05", "take": "7"})
    project.parts["clip_c", 1, "info"] = numbered.model_dump(mode="json", by_alias=True)
    align.run(project, AlignParams(mirroring="add"))
    found = {name: (info.take, info.subject) for name, info in infos(project).items() if len(name) == 1}
    assert found == {"a": ("walk", "02"), "b": ("walk", "02"), "c": ("05 · 7", "05"), "d": ("clip_d", None)}
    examples = [
        StoredExample("", documents.clip_from_document(
            MotionDocument.model_validate(output.parts["motion"]), walk().skeleton), output.parts["info"])
        for output in project.staged
    ]  # fmt: skip
    groups = ExampleGroups.of(set_from_examples(examples))
    assert (len(examples), groups.take_count, groups.subject_count) == (8, 3, 0)


def test_every_clip_becomes_an_aligned_one_with_the_way_back(project: Project) -> None:
    result = align.run(project, AlignParams(reference="clip_a", suffix=" aligned", tags=("walk",)))
    assert result["clips"] == 4
    assert result["reference"] == "walks/a"
    assert result["frames"] == 60
    assert result["refused"] == []
    assert [output.item_name for output in project.staged] == [f"{name} aligned" for name in NAMES]
    for output, row in zip(project.staged, result["aligned"], strict=True):
        info = AlignmentInfo.model_validate(output.parts["info"])
        motion = MotionDocument.model_validate(output.parts["motion"])
        assert output.kind is Kind.PROCESSED
        assert output.collection == "walks"
        assert output.tags == ("walk",)
        assert len(motion.poses) == len(info.time_function) == 60
        assert present(info.clip).item == row["item"]
        assert present(info.reference).item == "clip_a"
        assert info.set == result["set"]
        assert info.cost == row["cost"]
        assert present(info.options).reference == "clip_a"
        assert {source.item for source in output.sources["clips"]} == {present(info.clip).item, "clip_a"}


def test_what_is_staged_makes_up_the_aligned_set_again(project: Project) -> None:
    align.run(project, AlignParams())
    examples = [
        StoredExample(
            output.name,
            documents.clip_from_document(MotionDocument.model_validate(output.parts["motion"]), walk().skeleton),
            output.parts["info"],
        )
        for output in project.staged
    ]
    back = set_from_examples(examples)
    assert [clip.uid for clip in back.clips] == [f"clip_{name}@1" for name in NAMES]
    assert back.poses.shape == (4, back.frame_count, 3 + 4 * walk().skeleton.joint_count)


def test_the_same_bytes_are_staged_for_any_number_of_threads(project: Project) -> None:
    digests = []
    for threads in (1, 2):
        project.threads, project.staged = threads, []
        result = align.run(project, AlignParams())
        digests.append((result["set"], [document_digest(output.parts) for output in project.staged]))
    assert digests[0] == digests[1]


def test_annotated_keyframes_are_matched_exactly(project: Project) -> None:
    frames = {"a": 20, "b": 18, "c": 24, "d": 22}
    for name, frame in frames.items():
        annotate(project, name, keyframes=keyframe(frame))
    result = align.run(project, AlignParams(reference="clip_a", layer="steps"))
    assert result["keyframes"] == {"down": 20}
    for name, info in infos(project).items():
        assert info.keyframes == {"down": 20}
        assert info.time_function[20] == frames[name]
    assert project.staged[0].sources["annotations"][0].item == "annotation_a_steps_1"


def test_only_labels_that_are_asked_for_cut(project: Project) -> None:
    for name in NAMES:
        said = (*keyframe(20), *keyframe(30, f"of {name}"))
        annotate(project, name, keyframes=said)
    result = align.run(project, AlignParams(labels=("down",)))
    assert list(result["keyframes"]) == ["down"]
    assert result["refused"] == []


def test_an_annotation_of_the_clips_own_revision_goes_before_others(project: Project) -> None:
    for name in NAMES:
        annotate(project, name, keyframes=keyframe(20))
    annotate(project, "b", revision=2, keyframes=keyframe(25))
    align.run(project, AlignParams(reference="clip_a"))
    assert infos(project)["b"].time_function[20] == 20.0


def test_clips_that_do_not_fit_are_refused_with_reasons_and_the_others_are_aligned(project: Project) -> None:
    add_clip(project, "short", walk().sliced(0, 3))
    add_clip(project, "other", generate_gait(1.3, 0.2, 1.0, stature_m=1.5), skeleton="skeleton_b")
    add_clip(project, "mute", walk())
    add_clip(project, "two", walk())
    add_clip(project, "odd", walk())
    for name in (*NAMES, "short", "other", "two"):
        annotate(project, name, keyframes=keyframe(1))
    annotate(project, "two", layer="more", keyframes=keyframe(1))
    annotate(project, "odd", keyframes=keyframe(5, "up"))
    result = align.run(project, AlignParams())
    assert result["clips"] == 4
    refused = {one["name"]: one for one in result["refused"]}
    assert {name: one["code"] for name, one in refused.items()} == {
        "walks/short": "too-short",
        "walks/other": "skeleton-mismatch",
        "walks/mute": "no-annotation",
        "walks/two": "several-annotations",
        "walks/odd": "labels-differ",
    }
    assert "marey retarget" in refused["walks/other"]["detail"]
    assert "(layers: more, steps)" in refused["walks/two"]["detail"]
    assert refused["walks/odd"]["item"] == "clip_odd"
    assert len(project.staged) == 4


def test_mirrored_twins_are_named_after_their_clips(project: Project) -> None:
    result = align.run(project, AlignParams(mirroring="add"))
    assert result["clips"] == 8
    assert sorted(output.item_name for output in project.staged) == sorted(
        name + end for name in NAMES for end in ("", " mirrored")
    )
    assert present(infos(project)["b mirrored"].clip).mirrored


def test_weights_may_go_by_standard_names(project: Project) -> None:
    plain = align.run(project, AlignParams(reference="clip_a"))
    weighed = align.run(project, AlignParams(reference="clip_a", weights={"left_wrist": 0.0, "LeftFoot": 5.0}))
    assert weighed["aligned"][1]["cost"] != plain["aligned"][1]["cost"]
    assert weighed["set"] != plain["set"]


def refusal(project: Project, **params: Any) -> JobRefused:
    with pytest.raises(JobRefused) as refused:
        align.run(project, AlignParams(**params))
    assert project.staged == []
    return refused.value


@pytest.mark.parametrize(
    ("params", "code", "said"),
    [
        ({"reference": "clip_z"}, "unknown-reference", "clip_z is not one of the clips"),
        ({"weights": {"Tail": 1.0}}, "unknown-joint", "Tail"),
        ({"layer": "steps"}, "no-annotations", "no annotations are given"),
    ],
)
def test_what_cannot_be_done_refuses_the_job(project: Project, params: dict[str, Any], code: str, said: str) -> None:
    refused = refusal(project, **params)
    assert refused.code == code
    assert said in refused.detail


def test_names_of_results_that_would_be_too_long_refuse_the_job(project: Project) -> None:
    first, *others = project.inputs["clips"]
    project.inputs["clips"] = (first.model_copy(update={"name": 250 * "n"}), *others)
    refused = refusal(project, suffix="-aligned")
    assert refused.code == "name-too-long"
    assert refused.detail.endswith(
        "of 258 characters, but at most 255 are allowed; rename the clip, or give a shorter suffix"
    )


def test_clips_that_cannot_be_read_refuse_the_job(project: Project) -> None:
    for pin in project.inputs["clips"]:
        place = (pin.item, pin.revision, "motion")
        motion = project.parts[place]
        project.parts[place] = motion | {"poses": motion["poses"] * np.nan}
    refused = refusal(project)
    assert refused.code == "too-few-clips"
    assert "clips can be read" in refused.detail


def test_a_job_that_is_left_with_one_clip_says_why_the_others_do_not_fit(project: Project) -> None:
    for name in NAMES:
        clip = walk() if name == "a" else walk().sliced(0, 2)
        add_clip(project, name, clip)
    project.inputs["clips"] = project.inputs["clips"][4:]
    refused = refusal(project)
    assert refused.code == "too-few-clips"
    assert "only 1 of 4 clips can be aligned" in refused.detail


def test_clips_of_which_none_is_annotated_are_refused_with_the_first_reason(project: Project) -> None:
    annotate(project, "z", keyframes=keyframe(5))
    refused = refusal(project)
    assert refused.code == "too-few-clips"
    assert "walks/a: none of the given annotations belongs to this clip; add an annotation" in refused.detail


def test_an_input_rig_of_another_skeleton_is_refused(project: Project) -> None:
    pin = PinnedInput(item="skeleton_z", revision=3, kind=Kind.SKELETON, name="z", collection="rigs")
    project.inputs["rig"] = (pin,)
    assert refusal(project).code == "wrong-rig"
