from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import ClipError
from marey_motion.gait import generate_gait
from marey_motion.kinematics import global_positions
from marey_motion.looping import LoopSeam
from marey_motion.resampling import count_samples, resample_clip
from marey_motion.skeleton import Skeleton

RATES_HZ = (24.0, 30.0, 50.0, 60.0, 119.88, 120.0)
CHAIN = Skeleton(
    ("root", "middle", "tip"),
    np.array([-1, 0, 1], np.int32),
    np.array([[0.0, 1.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.4, 0.0]]),
    np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
)


def swinging(frames: int, rate_hz: float) -> Clip:
    """Return a clip of a chain that swings smoothly; the motion is the same at any frame rate."""
    seconds = np.arange(frames) / rate_hz
    poses = np.zeros((frames, 15))
    poses[:, 0], poses[:, 1], poses[:, 2] = np.sin(seconds), 1.0, 0.5 * seconds**2
    for joint, (axis, size) in enumerate((("y", 1.0), ("x", 0.6), ("z", 0.9))):
        turn = Rotation.from_euler(axis, size * np.sin(2.0 * seconds + joint)[:, None])
        poses[:, 3 + 4 * joint : 7 + 4 * joint] = turn.as_quat(scalar_first=True)
    moved = np.stack((0.1 * np.cos(seconds), 0.4 + 0 * seconds, 0.05 * seconds), axis=1)
    return Clip(CHAIN, rate_hz, poses.astype(np.float32), moved[:, None].astype(np.float32), (2,))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_the_motion_is_the_same_at_any_rate(rate_hz: float) -> None:
    source = swinging(int(3 * rate_hz) + 1, rate_hz)
    resampled = resample_clip(source, 60.0)
    expected = swinging(resampled.frame_count, 60.0)
    assert resampled.frame_rate_hz == 60.0
    np.testing.assert_allclose(global_positions(resampled), global_positions(expected), atol=3e-5)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_first_frames_coincide_and_none_lies_beyond_the_last(rate_hz: float) -> None:
    source = swinging(101, rate_hz)
    resampled = resample_clip(source, 60.0)
    np.testing.assert_allclose(resampled.poses[0], source.poses[0], atol=1e-6)
    last_s = (resampled.frame_count - 1) / 60.0
    assert last_s <= 100 / rate_hz + 1e-9
    assert last_s > 100 / rate_hz - 1 / 60.0


@pytest.mark.parametrize("rate", ["24", "30", "48", "120", "240", "23.976", "29.97", "119.88"])
def test_no_frame_is_lost_or_won_by_rounding(rate: str) -> None:
    for frames in range(1, 3000):
        exact = (frames - 1) * 60 // Fraction(rate) + 1
        assert count_samples(frames, float(rate), 60.0) == exact


def test_every_second_frame_is_taken_as_it_is_and_the_same_rate_changes_nothing() -> None:
    source = swinging(99, 120.0)
    resampled = resample_clip(source, 60.0)
    assert resampled.poses.tobytes() == source.poses[::2].tobytes()
    assert resampled.translations is not None
    assert source.translations is not None
    assert resampled.translations.tobytes() == source.translations[::2].tobytes()
    assert resample_clip(source, 120.0) is source


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
def test_few_frames_are_enough(frames: int) -> None:
    resampled = resample_clip(swinging(frames, 24.0), 60.0)
    assert resampled.frame_count == int((frames - 1) * 2.5) + 1
    np.testing.assert_allclose(np.linalg.norm(resampled.rotations, axis=-1), 1.0, atol=1e-6)


def test_quaternions_that_change_their_sign_are_the_same_rotation() -> None:
    source = swinging(40, 30.0)
    poses = source.poses.copy()
    poses[17:, 3:7] *= -1.0
    flipped = resample_clip(Clip(CHAIN, 30.0, poses, source.translations, (2,)), 60.0)
    same = resample_clip(source, 60.0)
    assert quaternions.angle_between(flipped.rotations, same.rotations).max() < 1e-6


def test_a_round_of_a_loop_is_sampled_evenly_through_its_seam() -> None:
    """26 frames at 25 Hz are 62.4 frames at 60 Hz: the round is sampled in 62 equal steps."""
    turns = 2 * np.pi * np.arange(26) / 26
    poses = np.zeros((26, 15))
    poses[:, 2] = np.arange(26) / 26
    poses[:, 1] = 1.0 + 0.1 * np.sin(turns)
    for joint in range(3):
        turn = Rotation.from_euler("x", 0.4 * np.sin(turns + joint)[:, None])
        poses[:, 3 + 4 * joint : 7 + 4 * joint] = turn.as_quat(scalar_first=True)
    loop = Clip(CHAIN, 25.0, poses.astype(np.float32))
    resampled = resample_clip(loop, 60.0, seam=LoopSeam(0.0, np.array([0.0, 1.0])))
    assert resampled.frame_count == 62
    expected = 2 * np.pi * np.arange(62) / 62
    np.testing.assert_allclose(resampled.root_translations[:, 1], 1.0 + 0.1 * np.sin(expected), atol=1e-5)
    np.testing.assert_allclose(resampled.root_translations[:, 2], np.arange(62) / 62, atol=1e-6)


@pytest.mark.parametrize("rate_hz", [0.0, -30.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate_hz: float) -> None:
    with pytest.raises(ClipError, match="positive number"):
        resample_clip(generate_gait(1.0, 0.0, 0.2), rate_hz)


def test_generated_walks_at_other_rates_agree_with_those_made_at_the_rate() -> None:
    """The tolerance is 3 cm, because 30 frames per second do not show exactly how a foot lands."""
    made = generate_gait(1.3, 0.4, 3.0, 60.0)
    for rate_hz in (30.0, 119.88, 120.0):
        resampled = resample_clip(generate_gait(1.3, 0.4, 3.0, rate_hz), 60.0)
        count = min(made.frame_count, resampled.frame_count)
        apart = np.linalg.norm(global_positions(made)[:count] - global_positions(resampled)[:count], axis=-1)
        assert apart.max() < 0.03
        assert np.sqrt((apart**2).mean()) < 5e-3
