"""Removal of noise from motions."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from tests.support.edited_takes import make_breathing_walk, make_walk, require_sound, same_poses

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.editing import smoothing
from marey_motion.editing.registry import apply_edit
from marey_motion.errors import EditError, UnknownJoint
from marey_schemas.editing.commands import Smooth

METHODS = ("savitzky_golay", "gaussian")


def still_on_a_line(frames: int = 50) -> Clip:
    """Return a clip of one pose that travels along a straight line."""
    pose = np.repeat(make_walk(seconds=0.2).poses[:1].astype(np.float64), frames, axis=0)
    pose[:, :3] += np.arange(frames)[:, None] * [0.01, 0.002, -0.03]
    return Clip(make_walk(seconds=0.2).skeleton, 60.0, pose.astype(np.float32))


def noisy(clip: Clip, size: float, seed: int = 5) -> Clip:
    random = np.random.default_rng(seed)
    turns = quaternions.from_rotation_vector(size * random.standard_normal((*clip.rotations.shape[:2], 3)))
    rotations = quaternions.multiply(clip.rotations.astype(np.float64), turns)
    root = clip.root_translations + size * 0.1 * random.standard_normal((clip.frame_count, 3))
    poses = np.concatenate((root, rotations.reshape(clip.frame_count, -1)), axis=1)
    return replace(clip, poses=poses.astype(np.float32))


@pytest.mark.parametrize("method", METHODS)
def test_poses_that_stay_and_straight_paths_are_kept(method: Literal["savitzky_golay", "gaussian"]) -> None:
    line = still_on_a_line()
    assert same_poses(apply_edit(line, [Smooth(method=method, window_s=0.5)]), line, 1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_no_frame_is_lost_and_the_ends_stay(method: Literal["savitzky_golay", "gaussian"]) -> None:
    walk = noisy(make_breathing_walk(), 0.02)
    smoothed = apply_edit(walk, [Smooth(method=method, window_s=0.3)])
    assert smoothed.frame_count == walk.frame_count
    assert same_poses(smoothed.sliced(0, 1), walk.sliced(0, 1))
    last = walk.frame_count - 1
    assert same_poses(smoothed.sliced(last, last + 1), walk.sliced(last, last + 1))
    require_sound(smoothed)


@pytest.mark.parametrize("method", METHODS)
def test_noise_gets_less(method: Literal["savitzky_golay", "gaussian"]) -> None:
    walk = make_walk()
    rough = noisy(walk, 0.03)
    smoothed = apply_edit(rough, [Smooth(method=method, window_s=0.25)])
    inner = slice(20, -20)

    def error(clip: Clip) -> float:
        turned = quaternions.angle_between(clip.rotations[inner], walk.rotations[inner])
        return float(np.sqrt(np.mean(turned**2)))

    assert error(smoothed) < 0.65 * error(rough)


def test_joints_that_are_not_named_stay() -> None:
    rough = noisy(make_walk(), 0.03)
    names = ["Head", "LeftArm"]
    smoothed = apply_edit(rough, [Smooth(joints=names, root_translation=False)])
    chosen = [rough.skeleton.index_of(name) for name in names]
    others = [joint for joint in range(rough.skeleton.joint_count) if joint not in chosen]
    assert np.array_equal(smoothed.rotations[:, others], rough.rotations[:, others])
    assert np.array_equal(smoothed.root_translations, rough.root_translations)
    assert not np.array_equal(smoothed.rotations[:, chosen], rough.rotations[:, chosen])


def test_a_range_is_smoothed_and_goes_over_softly() -> None:
    rough = noisy(make_walk(), 0.03)
    whole = apply_edit(rough, [Smooth(window_s=0.3)])
    part = apply_edit(rough, [Smooth(window_s=0.3, frames=(50, 130), border_s=0.2)])
    assert np.array_equal(part.poses[:50], rough.poses[:50])
    assert np.array_equal(part.poses[130:], rough.poses[130:])
    assert same_poses(part.sliced(70, 110), whole.sliced(70, 110))
    shares = quaternions.angle_between(part.rotations, rough.rotations)[50:62].max(axis=1)
    assert shares[0] < 0.2 * shares[6:].max()


def test_signs_that_flip_do_not_disturb_the_means() -> None:
    walk = make_walk()
    rotations = walk.rotations.copy()
    rotations[40:, 3] *= -1.0
    flipped = replace(
        walk, poses=np.concatenate((walk.root_translations, rotations.reshape(walk.frame_count, -1)), axis=1)
    )
    smooth = [Smooth(window_s=0.2)]
    assert same_poses(apply_edit(flipped, smooth), apply_edit(walk, smooth))


def test_a_joint_that_spins_within_the_window_is_refused_by_name() -> None:
    walk = make_walk()
    rotations = walk.rotations.astype(np.float64)
    head = walk.skeleton.index_of("Head")
    rotations[:, head] = quaternions.from_axis_angle([0.0, 1.0, 0.0], np.arange(walk.frame_count) * 1.5)
    poses = np.concatenate((walk.root_translations, rotations.reshape(walk.frame_count, -1)), axis=1)
    with pytest.raises(EditError, match="joint Head") as refused:
        apply_edit(replace(walk, poses=poses.astype(np.float32)), [Smooth(method="gaussian", window_s=1.0)])
    assert refused.value.code == "window-too-long"


def test_a_window_of_fewer_frames_than_the_polynomial_needs_is_refused() -> None:
    with pytest.raises(EditError, match="too short for polynomials of degree 5"):
        apply_edit(make_walk(), [Smooth(window_s=0.05, order=5)])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_motions_shorter_than_the_window_are_smoothed_too(
    method: Literal["savitzky_golay", "gaussian"], frames: int
) -> None:
    few = noisy(make_walk(), 0.03).sliced(0, frames)
    smoothed = apply_edit(few, [Smooth(method=method, window_s=2.0)])
    assert smoothed.frame_count == frames
    assert same_poses(smoothed.sliced(0, 1), few.sliced(0, 1))
    assert same_poses(smoothed.sliced(frames - 1, frames), few.sliced(frames - 1, frames))


def test_an_unknown_joint_is_told_with_its_nearest_names() -> None:
    with pytest.raises(UnknownJoint, match="LeftArm"):
        apply_edit(make_walk(), [Smooth(joints=["LeftArn"])])


@pytest.mark.parametrize("method", ["savitzky_golay", "gaussian"])
def test_means_over_long_windows_are_those_of_short_ones(
    method: Literal["savitzky_golay", "gaussian"], monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = make_walk(turn_rate_rad_s=0.3, seconds=12.0)
    commands = [Smooth(method=method, window_s=10.0)]
    quick = apply_edit(clip, commands)
    monkeypatch.setattr(smoothing, "LONG_WINDOW", 1_000_000)
    np.testing.assert_allclose(quick.poses, apply_edit(clip, commands).poses, atol=2e-6)
