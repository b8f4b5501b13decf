"""Changes of frame rate and speed, and mirroring."""

from math import degrees
from typing import Any, cast

import numpy as np
import pytest
from tests.support.edited_takes import make_breathing_walk, make_walk, same_poses

from marey_motion.editing.registry import apply_edit
from marey_motion.errors import EditError, MappingError
from marey_motion.kinematics import global_positions
from marey_motion.resampling import resample_clip
from marey_schemas.editing.commands import Mirror, Resample, Retime, Rotate, Smooth, Trim


def test_resampling_keeps_the_time_and_changes_the_rate() -> None:
    walk = make_breathing_walk()
    slow = apply_edit(walk, [Resample(frame_rate_hz=24.0)])
    assert slow.frame_rate_hz == 24.0
    assert same_poses(slow, resample_clip(walk, 24.0), 1e-6)
    assert abs(slow.duration_s - walk.duration_s) < 1 / 24


def test_frames_of_rates_that_divide_each_other_are_taken_as_they_are() -> None:
    walk = make_breathing_walk()
    half = apply_edit(walk, [Resample(frame_rate_hz=30.0)])
    assert np.array_equal(half.poses, walk.poses[::2])


def test_retiming_keeps_the_rate_and_changes_the_time() -> None:
    walk = make_breathing_walk()
    fast = apply_edit(walk, [Retime(speed=2.0)])
    assert fast.frame_rate_hz == walk.frame_rate_hz
    assert np.array_equal(fast.poses, walk.poses[::2])
    slow = apply_edit(walk, [Retime(speed=0.5)])
    assert slow.frame_count == 2 * walk.frame_count - 1
    assert np.abs(global_positions(slow)[::2] - global_positions(walk)).max() < 1e-5


def test_there_and_back_is_nearly_the_motion() -> None:
    walk = make_walk()
    back = apply_edit(walk, [Retime(speed=0.5), Retime(speed=2.0)])
    assert same_poses(back, walk, 1e-5)


@pytest.mark.parametrize("command", [Resample(frame_rate_hz=100_000.0), Retime(speed=0.01)])
def test_a_result_that_is_too_long_is_refused_before_it_is_made(command: Resample | Retime) -> None:
    walk = make_walk()
    with pytest.raises(EditError, match="frames; with this skeleton a clip may have") as refused:
        apply_edit(walk, [command], most_numbers=10 * walk.poses.size)
    assert refused.value.code == "edit-too-large"


def test_a_result_of_the_greatest_size_is_made_and_a_larger_one_is_refused() -> None:
    walk, slow = make_walk(), Retime(speed=0.5)
    frames = 2 * walk.frame_count - 1
    most = frames * walk.poses.shape[1]
    assert apply_edit(walk, [slow], most_numbers=most).frame_count == frames
    with pytest.raises(EditError, match=f"the edited clip would have {frames} frames"):
        apply_edit(walk, [slow], most_numbers=most - 1)


def test_a_mirrored_mirror_image_is_the_motion() -> None:
    walk = make_breathing_walk(turn_rate_rad_s=0.5)
    once = apply_edit(walk, [Mirror()])
    left, right = (walk.skeleton.index_of(name) for name in ("LeftHand", "RightHand"))
    reflected = global_positions(walk)[:, right] * [-1.0, 1.0, 1.0]
    assert np.abs(global_positions(once)[:, left] - reflected).max() < 0.2
    twice = apply_edit(walk, [Mirror(), Mirror()])
    assert np.abs(global_positions(twice) - global_positions(walk)).max() < 1e-5


def test_a_body_that_is_not_known_is_told_only_where_it_matters() -> None:
    from marey_motion.editing.take import EditedBody

    def unknown(_skeleton: object) -> object:
        raise MappingError("nobody knows this body")

    walk = make_walk()
    body = EditedBody(walk.skeleton, cast(Any, unknown))
    kept = apply_edit(walk, [Trim(stop=50), Smooth(), Rotate(angle_deg=degrees(1.0))], body=body)
    assert kept.frame_count == 50
    with pytest.raises(MappingError, match="nobody knows this body"):
        apply_edit(walk, [Mirror()], body=body)
