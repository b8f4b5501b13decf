"""Differences between clips, for edits whose effects are known exactly."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.edited_takes import make_breathing_walk, make_walk, under_static_root
from tests.support.present import present

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.difference.changes import MatchedFrames, spans_where
from marey_motion.difference.clips import MOST_ROWS, compare_clips
from marey_motion.editing.registry import apply_edit
from marey_motion.resampling import resample_clip
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.differences import DifferenceOptions, MotionDifference
from marey_schemas.editing.commands import Rotate, Translate

WALK = make_walk(turn_rate_rad_s=0.5, seconds=2.0)
FRAMES = WALK.frame_count
ARM = WALK.skeleton.index_of("LeftArm")


def joined(*clips: Clip) -> Clip:
    moved = None if clips[0].translations is None else np.concatenate([present(clip.translations) for clip in clips])
    return replace(clips[0], poses=np.concatenate([clip.poses for clip in clips]), translations=moved)


def noisy(clip: Clip, amount: float = 0.01) -> Clip:
    rotations = clip.rotations + np.random.default_rng(7).normal(scale=amount, size=clip.rotations.shape)
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    poses = np.concatenate((clip.root_translations, rotations.reshape(clip.frame_count, -1)), axis=1)
    return replace(clip, poses=poses.astype(np.float32))


def at_speed(clip: Clip, speed: float) -> Clip:
    return replace(resample_clip(clip, clip.frame_rate_hz / speed), frame_rate_hz=clip.frame_rate_hz)


def compare(before: Clip, after: Clip, **options: float) -> MotionDifference:
    return compare_clips(before, after, DifferenceOptions(**options))[0]


def runs(difference: MotionDifference) -> list[tuple[str, tuple[int, int], tuple[int, int]]]:
    return [(run.change, run.before, run.after) for run in difference.runs]


def is_unchanged_where_matched(difference: MotionDifference) -> bool:
    return not difference.rotations and difference.path is None and not difference.translations


@pytest.mark.parametrize("clip", [WALK, make_breathing_walk(seconds=1.0), under_static_root(WALK), WALK.sliced(0, 1)])
def test_a_clip_does_not_differ_from_itself(clip: Clip) -> None:
    found = compare(clip, clip)
    assert runs(found) == [("matched", (0, clip.frame_count), (0, clip.frame_count))]
    assert is_unchanged_where_matched(found)
    assert found.skeleton is None
    assert (found.frames_per_frame, found.duration_ratio) == (1.0, 1.0)


@given(start=st.integers(0, FRAMES - 1), count=st.integers(1, 40))
@settings(max_examples=10, deadline=None)
def test_removed_frames_are_found_wherever_they_were_and_inserted_frames_by_exchanging_the_clips(
    start: int, count: int
) -> None:
    stop = min(start + count, FRAMES)
    kept = [WALK.sliced(*ends) for ends in ((0, start), (stop, FRAMES)) if ends[0] < ends[1]]
    shorter = joined(*kept)
    found = compare(WALK, shorter)
    expected = [("matched", (0, start), (0, start)), ("removed", (start, stop), (start, start)),
                ("matched", (stop, FRAMES), (start, shorter.frame_count))]  # fmt: skip
    assert runs(found) == [run for run in expected if run[1][0] < run[1][1]]
    assert is_unchanged_where_matched(found)
    mirrored = [("inserted" if change == "removed" else change, new, old) for change, old, new in runs(found)]
    assert runs(compare(shorter, WALK)) == mirrored


@pytest.mark.parametrize("amount", [0.002, 0.02])
def test_frames_are_matched_although_every_frame_was_edited_slightly(amount: float) -> None:
    edited = noisy(joined(WALK.sliced(0, 40), WALK.sliced(60, FRAMES)), amount)
    assert runs(compare(WALK, edited)) == [
        ("matched", (0, 40), (0, 40)),
        ("removed", (40, 60), (40, 40)),
        ("matched", (60, FRAMES), (40, FRAMES - 20)),
    ]


def test_every_frame_of_both_clips_is_in_one_run() -> None:
    found = compare(WALK, noisy(joined(WALK.sliced(70, 100), WALK.sliced(0, 50), WALK.sliced(30, 60)), 0.05))
    for side, count in ((1, FRAMES), (2, 110)):
        edges = [run[side] for run in runs(found)]
        assert edges[0][0] == 0
        assert edges[-1][1] == count
        assert all(before[1] == after[0] for before, after in pairwise(edges))


def test_still_motion_is_matched_in_one_run() -> None:
    still = replace(WALK, poses=np.repeat(WALK.poses[:1], 50, axis=0))
    assert runs(compare(still, still.sliced(0, 35))) == [
        ("matched", (0, 35), (0, 35)),
        ("removed", (35, 50), (35, 35)),
    ]


@pytest.mark.parametrize("amount", [0.0, 0.003])
def test_repeated_motion_has_no_more_frames_removed_than_were_removed(amount: float) -> None:
    cycle = replace(WALK.sliced(0, 30), poses=WALK.poses[:30] * np.r_[[0, 1, 0], np.ones(4 * 26)].astype(np.float32))
    found = compare(joined(*[cycle] * 4), noisy(joined(*[cycle] * 4).sliced(7, 120), amount))
    assert runs(found) == [("removed", (0, 7), (0, 0)), ("matched", (7, 120), (0, 113))]


def turned(clip: Clip, joint: int, frames: slice, angle_deg: float) -> Clip:
    rotations = clip.rotations.astype(np.float64)
    turn = quaternions.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.radians(angle_deg))
    rotations[frames, joint] = quaternions.multiply(rotations[frames, joint], turn)
    poses = np.concatenate((clip.root_translations, rotations.reshape(clip.frame_count, -1)), axis=1)
    return replace(clip, poses=poses.astype(np.float32))


@pytest.mark.parametrize("angle_deg", [0.5, 20.0, 179.0])
def test_the_change_of_a_joint_is_measured_in_degrees_with_its_times(angle_deg: float) -> None:
    found = compare(WALK, turned(WALK, ARM, slice(30, 60), angle_deg).sliced(10, FRAMES), threshold_deg=2.0)
    (joint,) = found.rotations
    assert joint.joint == "LeftArm"
    assert joint.largest == pytest.approx(angle_deg, abs=1e-3)
    assert joint.mean == pytest.approx(angle_deg * 30 / (FRAMES - 10), abs=1e-3)
    assert 20 <= joint.largest_at < 50
    assert joint.spans == (((20, 50),) if angle_deg > 2.0 else ())
    assert found.path is None


def test_quaternions_of_opposite_sign_are_the_same_rotation() -> None:
    poses = WALK.poses.copy()
    poses[20:50, 3:] *= -1.0
    assert is_unchanged_where_matched(compare(WALK, replace(WALK, poses=poses)))


def test_a_clip_moved_as_a_whole_has_a_moved_path_and_no_other_change() -> None:
    moved = apply_edit(WALK, [Rotate(angle_deg=40.0, pivot="origin"), Translate(shift_m=(0.5, 0.1, -0.2))])
    found = compare(WALK, moved.sliced(12, FRAMES))
    assert runs(found)[0] == ("removed", (0, 12), (0, 0))
    assert not found.rotations
    assert found.path is not None
    assert found.path.moved is not None
    assert found.path.moved.turn_deg == pytest.approx(40.0, abs=1e-3)
    assert found.path.moved.shift_cm == pytest.approx((50.0, 10.0, -20.0), abs=1e-3)
    assert found.path.moved.remaining_cm < 1e-3
    steps = moved.root_translations[12:] - WALK.root_translations[12:]
    assert found.path.largest == pytest.approx(100.0 * np.linalg.norm(steps, axis=1).max(), abs=1e-3)


def test_a_path_that_changed_in_a_few_frames_was_not_moved_as_a_whole() -> None:
    poses = WALK.poses.copy()
    poses[50:60, 1] += 0.03
    found = compare(WALK, replace(WALK, poses=poses)).path
    assert found is not None
    assert found.moved is None
    assert (found.joint, found.spans) == ("Hips", ((50, 60),))
    assert found.largest == pytest.approx(3.0, abs=1e-4)


def test_the_path_below_a_static_root_is_that_of_the_hips() -> None:
    poses = WALK.poses.copy()
    poses[:, 0] += 0.2
    found = compare(under_static_root(WALK), under_static_root(replace(WALK, poses=poses)))
    assert found.path is not None
    assert found.path.joint == "Hips"
    assert found.path.moved is not None
    assert found.path.moved.shift_cm == pytest.approx((20.0, 0.0, 0.0), abs=1e-3)
    assert not found.translations


@pytest.mark.parametrize("speed", [0.5, 0.8, 1.1, 1.25, 2.0])
def test_a_retimed_clip_has_another_duration_and_no_other_change(speed: float) -> None:
    found = compare(WALK, at_speed(WALK, speed))
    assert found.duration_ratio == pytest.approx(1.0 / speed, rel=1e-9)
    assert [run.change for run in found.runs] == ["matched"]
    assert all(joint.largest < 0.1 for joint in found.rotations)


@pytest.mark.parametrize(("start", "stop", "speed"), [(12, FRAMES, 1.25), (40, 100, 0.8), (60, FRAMES, 0.7)])
def test_a_part_of_a_clip_is_found_at_another_speed(start: int, stop: int, speed: float) -> None:
    found = compare(WALK, at_speed(WALK.sliced(start, stop), speed))
    assert found.duration_ratio == pytest.approx(1.0 / speed, rel=1e-3)
    removed = [run.before for run in found.runs if run.change == "removed"]
    assert removed[0] == (0, start)
    assert len(removed) == 1 + (stop < FRAMES)


def test_a_resampled_clip_has_the_same_duration() -> None:
    found = compare(WALK, resample_clip(WALK, 30.0))
    assert (found.frames_per_frame, found.duration_ratio, found.frame_rate_hz) == (0.5, 1.0, (60.0, 30.0))
    assert is_unchanged_where_matched(found)


def test_the_same_frames_at_another_rate_are_retimed() -> None:
    found = compare(WALK, replace(WALK, frame_rate_hz=30.0))
    assert (found.frames_per_frame, found.duration_ratio) == (1.0, 2.0)
    assert is_unchanged_where_matched(found)


def test_joints_of_both_skeletons_are_compared_also_if_they_were_renamed() -> None:
    own = WALK.skeleton
    names = tuple("Shoulder" if name == "LeftArm" else name for name in own.joint_names)
    other = Skeleton(names, own.parents, own.offsets, own.rest_rotations, own.end_sites)
    changed = turned(WALK, ARM, slice(0, FRAMES), 5.0)
    found = compare(WALK, Clip(other, WALK.frame_rate_hz, changed.poses))
    assert found.skeleton is not None
    assert found.skeleton.renamed == (("LeftArm", "Shoulder"),)
    assert [(joint.joint, round(joint.largest, 3)) for joint in found.rotations] == [("Shoulder", 5.0)]


def test_translations_are_compared_with_offsets_where_a_clip_has_none() -> None:
    breathing = make_breathing_walk(turn_rate_rad_s=0.5, seconds=2.0)
    found = compare(WALK, breathing)
    assert found.translated_joints == ((), ("Spine1", "LeftArm"))
    assert {joint.joint for joint in found.translations} == {"LeftArm", "Spine1"}
    arm = present(breathing.translations)[:, breathing.translated_joints.index(ARM)] - WALK.skeleton.offsets[ARM]
    (change,) = (joint for joint in found.translations if joint.joint == "LeftArm")
    assert change.largest == pytest.approx(100.0 * np.linalg.norm(arm, axis=1).max(), rel=1e-5)


def test_the_plot_shows_the_largest_change_of_each_row_and_no_change_where_no_frame_is_matched() -> None:
    long = make_walk(turn_rate_rad_s=0.1, seconds=20.0)
    changed = joined(long.sliced(0, 1), turned(long, ARM, slice(101, 102), 10.0))
    _, plot = compare_clips(long, joined(WALK.sliced(5, 20), changed.sliced(1, 1201)), plot=True)
    assert plot is not None
    assert plot.rotation_deg.shape == (MOST_ROWS, long.skeleton.joint_count)
    row = np.searchsorted(plot.frames, 15 + 101, side="right") - 1
    assert plot.rotation_deg[row, plot.joints.index("LeftArm")] == pytest.approx(10.0, abs=1e-3)
    assert (plot.rotation_deg[:7] == -1.0).all()
    assert plot.rotation_deg[8:].min() == 0.0


@pytest.mark.parametrize(
    ("frames", "spans"),
    [([], ()), ([3], ((3, 4),)), ([3, 4, 5], ((3, 6),)), ([3, 8], ((3, 9),)), ([3, 10], ((3, 4), (10, 11)))],
)
def test_spans_less_than_a_tenth_of_a_second_apart_are_joined(frames: list[int], spans: Any) -> None:
    exceeds = np.zeros(100, dtype=np.bool_)
    exceeds[frames] = True
    assert spans_where(exceeds, MatchedFrames(np.arange(100), 60.0)) == spans


def test_the_number_of_spans_is_limited() -> None:
    exceeds = np.arange(100_000) % 20 == 0
    spans = spans_where(exceeds, MatchedFrames(np.arange(100_000), 60.0))
    assert 0 < len(spans) <= 100
    assert spans[0][0] == 0
    assert spans[-1][1] == 99_981
