"""Alignment of the examples of an action, each as a whole clip."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from tests.support.alignment_examples import body_of, moved, played, sine_warp, walk, warped_walks

from marey_motion.alignment import aligning
from marey_motion.alignment import reference as references
from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligning import (
    MIRRORED,
    SourceExample,
    align_clips,
    joint_weights,
    restore,
    with_mirrored,
)
from marey_motion.alignment.segments import Cut
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion
from marey_schemas.options.alignment import AlignOptions

BODY = body_of(walk())
TO_FIRST = AlignOptions(reference="clip_a@1")


def raised(examples: list[SourceExample], options: AlignOptions | None = None) -> MotionError:
    with pytest.raises(MotionError) as error:
        align_clips(examples, BODY, options)
    return error.value


def as_bytes(aligned: AlignedSet) -> tuple[bytes, str, Mapping[str, int]]:
    arrays = [
        array.tobytes()
        for clip in aligned.clips
        for array in (clip.motion.poses, clip.time_function, np.array([clip.cost, clip.placement.heading_rad]))
    ]
    return b"".join(arrays), aligned.reference, aligned.keyframes


def test_a_known_warp_is_recovered_within_a_frame() -> None:
    examples, warps = warped_walks()
    aligned = align_clips(examples, BODY, TO_FIRST)
    assert aligned.frame_count == 60
    for clip in aligned.clips:
        frames = np.arange(clip.source_frames)
        found = np.interp(frames, clip.time_function, np.arange(60))
        assert np.abs(found - warps[clip.uid]).max() <= 1.0


def test_aligned_examples_of_one_walk_are_nearly_the_same_motion() -> None:
    examples, _ = warped_walks()
    aligned = align_clips(examples, BODY, TO_FIRST)
    reference = aligned.clips[0].motion.positions(BODY.skeleton)
    for clip in aligned.clips:
        assert np.abs(clip.motion.positions(BODY.skeleton) - reference).max() < 0.05
        assert clip.cost < 1e-4


def test_the_reference_keeps_every_frame_and_its_own_time() -> None:
    examples, _ = warped_walks()
    aligned = align_clips(examples, BODY, TO_FIRST)
    own = aligned.clips[0]
    assert own.time_function.tolist() == list(range(60))
    assert own.cost == pytest.approx(0.0, abs=1e-15)
    assert own.motion.positions(BODY.skeleton) == pytest.approx(
        Motion.of(examples[0].clip).positions(BODY.skeleton), abs=1e-5
    )


def test_every_quaternion_is_continuous_in_time_and_on_the_side_of_the_reference() -> None:
    examples, _ = warped_walks()
    flipped = examples[2].clip.poses.copy()
    flipped[:, 3:7] *= -1.0
    flipped[20:, 7:11] *= -1.0
    examples[2] = replace(examples[2], clip=replace(examples[2].clip, poses=flipped))
    aligned = align_clips(examples, BODY, TO_FIRST)
    reference = aligned.clips[0].motion.rotations
    for clip in aligned.clips:
        rotations = clip.motion.rotations
        assert np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]).min() > 0.0
        assert np.einsum("fjc,fjc->j", rotations, reference).min() > 0.0


def test_more_than_half_a_turn_does_not_break_the_signs() -> None:
    """An earlier program compared every frame with the first one, so rotations by more than half a turn jumped."""
    spin = generate_gait(1.0, 2.6, 2.0)
    faster = played(spin, sine_warp(120, 101))
    aligned = align_clips([SourceExample("a@1", "a", spin), SourceExample("b@1", "b", faster)], BODY)
    for clip in aligned.clips:
        root = clip.motion.rotations[:, 0]
        assert np.einsum("fc,fc->f", root[1:], root[:-1]).min() > 0.9
    assert np.abs(aligned.clips[0].motion.rotations - aligned.clips[1].motion.rotations).max() < 0.15


@pytest.mark.parametrize("reference", ["medoid", "nearest_mean_length", "clip_c@1"])
def test_the_same_bytes_come_out_for_any_threads_and_any_order(reference: str) -> None:
    examples, _ = warped_walks(5)
    options = AlignOptions(reference=reference)
    expected = as_bytes(align_clips(examples, BODY, options, threads=1))
    assert as_bytes(align_clips(examples, BODY, options, threads=2)) == expected
    for order in list(permutations(examples))[:40:13]:
        assert as_bytes(align_clips(order, BODY, options, threads=2)) == expected


def test_the_medoid_is_nearer_to_the_others_than_an_outlier() -> None:
    examples, _ = warped_walks(4)
    strange = generate_gait(2.4, -1.0, 1.0)
    aligned = align_clips([SourceExample("a@1", "a", strange), *examples], BODY)
    assert aligned.reference != "a@1"


def test_the_number_of_compared_pairs_does_not_grow_with_the_square_of_the_clips(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(references, "MOST_COMPARED", 4)
    compared: list[tuple[float, int]] = []
    for count in (8, 16):
        examples, _ = warped_walks(count)
        aligned = align_clips(
            examples, BODY, progress=lambda done, total, _note: compared.append((done, int(total or 0)))
        )
        assert len(aligned.clips) == count
        assert max(compared) == (6, 6)
        assert as_bytes(align_clips(examples[::-1], BODY, threads=2)) == as_bytes(aligned)


def test_a_reference_that_is_named_is_found_without_comparing_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    examples, _ = warped_walks(4)

    def compare(*_arguments: Any, **_options: Any) -> None:
        raise AssertionError("pairs were compared")

    monkeypatch.setattr(aligning, "pairwise_totals", compare)
    with pytest.raises(AssertionError, match="pairs were compared"):
        align_clips(examples, BODY)
    for one in examples:
        assert align_clips(examples, BODY, AlignOptions(reference=one.uid)).reference == one.uid


def test_cuts_are_matched_exactly_and_become_keyframes() -> None:
    examples, warps = warped_walks(4)
    with_cuts = []
    for one in examples:
        frames = [int(np.argmin(np.abs(warps[one.uid] - place))) for place in (20, 41)]
        cuts = (Cut(("left down",), frames[0]), Cut(("right down",), frames[1]))
        with_cuts.append(replace(one, cuts=cuts))
    aligned = align_clips(with_cuts, BODY, TO_FIRST)
    assert aligned.keyframes == {"left down": 20, "right down": 41}
    for clip, one in zip(aligned.clips, with_cuts, strict=True):
        assert clip.time_function[[20, 41]].tolist() == [float(cut.frame) for cut in one.cuts]
        assert np.diff(clip.time_function).min() > 0.0


def test_an_example_with_other_labels_is_refused_by_name() -> None:
    examples, _ = warped_walks(4)
    labelled = [replace(one, cuts=(Cut(("contact",), 20),)) for one in examples]
    labelled[2] = replace(labelled[2], cuts=(Cut(("release",), 20),))
    error = raised(labelled)
    assert error.code == "labels-differ"
    assert "walk c" in str(error)
    refused = []
    aligned = align_clips(labelled, BODY, on_refusal=lambda one, error: refused.append((one.name, error.code)))
    assert refused == [("walk c", "labels-differ")]
    assert [clip.name for clip in aligned.clips] == ["walk a", "walk b", "walk d"]


def test_labels_follow_a_reference_that_is_named() -> None:
    examples, _ = warped_walks(3)
    labelled = [replace(one, cuts=(Cut(("contact",), 20),)) for one in examples]
    labelled[0] = replace(labelled[0], cuts=(Cut(("start",), 20),))
    error = raised(labelled, TO_FIRST)
    assert "walk b" in str(error)
    assert "the annotation cuts the clip at contact, but the other clips at start" in str(error)


def test_clips_of_several_rates_are_aligned_at_the_commonest_that_of_the_reference_or_the_one_asked_for() -> None:
    examples, warps = warped_walks(3)
    half = Clip(BODY.skeleton, 30.0, walk().poses[::2])
    mixed = [*examples, SourceExample("clip_z@1", "slow", half, (Cut(("down",), 15),))]
    mixed = [
        replace(one, cuts=one.cuts or (Cut(("down",), int(np.argmin(np.abs(warps[one.uid] - 30)))),)) for one in mixed
    ]
    assert align_clips(mixed, BODY).frame_rate_hz == 60.0
    by_slow = align_clips(mixed, BODY, AlignOptions(reference="clip_z@1"))
    assert by_slow.frame_rate_hz == 30.0
    assert by_slow.frame_count == 30
    assert by_slow.keyframes == {"down": 15}
    asked = align_clips(mixed, BODY, AlignOptions(reference="clip_z@1", rate_hz=120.0))
    assert asked.frame_rate_hz == 120.0
    assert asked.keyframes == {"down": 60}


def test_a_restored_example_is_the_source_again() -> None:
    examples, _ = warped_walks()
    aligned = align_clips(examples, BODY, TO_FIRST)
    for clip, one in zip(aligned.clips, examples, strict=True):
        motion, source = restore(clip, BODY.skeleton), Motion.of(one.clip)
        assert motion.frame_count == source.frame_count
        gaps = np.linalg.norm(motion.positions(BODY.skeleton) - source.positions(BODY.skeleton), axis=-1)
        limit_m = 1e-9 if clip.uid == aligned.reference else 0.02
        assert gaps.max() < limit_m


def test_where_a_clip_stood_does_not_matter() -> None:
    examples, _ = warped_walks(3)
    away = [replace(one, clip=moved(one.clip, 2.0, 30.0, -20.0)) for one in examples]
    here, there = (align_clips(some, BODY, TO_FIRST) for some in (examples, away))
    assert there.time_functions == pytest.approx(here.time_functions, abs=1e-9)
    assert there.clips[1].placement.x != pytest.approx(here.clips[1].placement.x)


def test_mirrored_examples_stand_beside_the_others() -> None:
    examples, _ = warped_walks(3)
    aligned = align_clips(with_mirrored(examples, BODY), BODY)
    uids = [clip.uid for clip in aligned.clips]
    assert uids == sorted(uids)
    assert sum(uid.endswith(MIRRORED) for uid in uids) == 3
    own, twin = aligned.clips[0].motion, aligned.clips[1].motion
    assert twin.root_translations[:, 1] == pytest.approx(own.root_translations[:, 1], abs=0.05)


def test_weights_fall_on_what_the_body_carries() -> None:
    names = BODY.skeleton.joint_names
    assert joint_weights(BODY, {}).tolist() == [1.0] * len(names)
    examples, _ = warped_walks(3)
    weights = {name: float(joint in BODY.feet) for joint, name in enumerate(names)}
    feet = align_clips(examples, BODY, TO_FIRST.replace(weights=weights))
    whole = align_clips(examples, BODY, TO_FIRST)
    assert feet.clips[1].cost != whole.clips[1].cost


def test_progress_counts_the_pairs_that_were_compared() -> None:
    examples, _ = warped_walks(5)
    told = []
    align_clips(examples, BODY, progress=lambda *step: told.append(step))
    assert told[-1] == (10, 10, "comparing 5 clips")


def short(frames: int) -> SourceExample:
    return SourceExample("short@1", "short", walk().sliced(0, frames))


@pytest.mark.parametrize(
    ("odd", "options", "code", "said"),
    [
        (short(3), None, "too-short", "short: the clip has 3 frames at 60 Hz; a clip to align must have 4 to 4000"),
        (
            SourceExample("long@1", "long", generate_gait(1.3, 0.2, 67.0)),
            None,
            "too-long",
            "long: the clip has 4020 frames at 60 Hz",
        ),
        (
            SourceExample("bones@1", "bones", generate_gait(1.3, 0.2, 1.0, stature_m=1.5)),
            None,
            "skeleton-mismatch",
            "bones: the clip has a different skeleton from the other clips; retarget it first",
        ),
        (
            SourceExample("cut@1", "cut", walk(), (Cut(("contact",), 60),)),
            None,
            "outside-clip",
            "cut: contact, frame 60: the frame of the cut is outside the clip, whose frames are 0 to 59",
        ),
        (short(8), TO_FIRST, "alignment-impossible", "short: .*60 frames cannot be aligned with 8"),
        (short(20), AlignOptions(reference="nobody"), "unknown-reference", "nobody: .*, medoid or nearest_mean"),
        (short(20), AlignOptions(weights={"tail": 2.0}), "unknown-joint", "tail"),
        (SourceExample("clip_a@1", "twin", walk()), None, "motion-invalid", "clip_a@1: two examples have this uid"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_name(
    odd: SourceExample, options: AlignOptions | None, code: str, said: str
) -> None:
    examples, _ = warped_walks(3)
    with pytest.raises(MotionError, match=said) as error:
        align_clips([*examples, odd], BODY, options)
    assert error.value.code == code


def test_fewer_than_two_examples_cannot_be_aligned() -> None:
    examples, _ = warped_walks(2)
    assert raised(examples[:1]).code == "too-few-clips"
    assert raised([]).code == "too-few-clips"
    refused = []
    with pytest.raises(MotionError, match="only 1 of 2 clips can be aligned"):
        align_clips([examples[0], short(2)], BODY, on_refusal=lambda *one: refused.append(one))
    assert len(refused) == 1


def test_a_reference_that_does_not_fit_is_not_left_out_silently() -> None:
    examples, _ = warped_walks(3)
    with pytest.raises(MotionError, match="short: the clip has 3 frames"):
        align_clips([*examples, short(3)], BODY, AlignOptions(reference="short@1"), on_refusal=lambda *_: None)


def test_more_than_fits_into_memory_is_refused_before_anything_is_computed() -> None:
    long = generate_gait(1.3, 0.2, 66.0)
    examples = [SourceExample(f"long@{index}", "long", long) for index in range(30)]
    error = raised(examples, AlignOptions(rate_hz=1000.0))
    assert error.code == "too-much"
    assert "a lower frame rate" in str(error)
