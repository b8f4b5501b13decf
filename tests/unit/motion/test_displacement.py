"""Changes of single frames, which are spread over the frames around them."""

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.editing.displacement import Window, displace, spread_displacements, windows_around
from marey_motion.errors import EditError
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion


@pytest.fixture(scope="module")
def walk() -> Motion:
    return Motion.of(generate_gait(1.2, 0.3, 2.0))


def _changed(motion: Motion, frames: np.ndarray, joints: tuple[int, ...], size_rad: float, seed: int = 0) -> Motion:
    random = np.random.default_rng(seed)
    part = motion.at_frames(frames)
    turns = quaternions.from_rotation_vector(random.normal(0.0, size_rad, (len(joints), 3)))
    part.rotations[:, joints] = quaternions.multiply(part.rotations[:, joints], turns)
    return part._replace(root_translations=part.root_translations + np.array([0.02, 0.01, -0.03]))


@pytest.mark.parametrize("blend", [0, 1, 2, 15])
def test_given_frames_become_what_they_should_and_no_bit_changes_outside(walk: Motion, blend: int) -> None:
    frames = np.arange(50, 61)
    wanted = _changed(walk, frames, (3, 8), 0.4)
    windows = windows_around(frames, blend, walk.frame_count)
    result = displace(walk, frames, wanted, windows)
    assert quaternions.angle_between(result.rotations[frames], wanted.rotations).max() < 1e-7
    np.testing.assert_allclose(result.root_translations[frames], wanted.root_translations, atol=1e-12)
    outside = np.r_[0 : 50 - blend, 61 + blend : walk.frame_count]
    for name in ("rotations", "root_translations", "translations"):
        assert getattr(result, name)[outside].tobytes() == getattr(walk, name)[outside].tobytes()
    others = np.setdiff1d(np.arange(walk.rotations.shape[1]), (3, 8))
    assert result.rotations[:, others].tobytes() == walk.rotations[:, others].tobytes()


def test_a_change_grows_from_zero_with_zero_slope_and_curvature() -> None:
    curve = spread_displacements(np.array([100]), np.ones((1, 1)), Window(0, 201))[:, 0]
    padded = np.concatenate((np.zeros(3), curve, np.zeros(3)))
    assert np.abs(np.diff(padded)[:4]).max() < 1e-3
    assert np.abs(np.diff(padded, 2)).max() < 4e-3
    assert curve.max() == pytest.approx(1.0, abs=1e-12)
    assert curve.min() >= 0.0
    np.testing.assert_allclose(curve, curve[::-1], atol=1e-10)


def test_a_held_change_stays_and_blends_like_a_cubic() -> None:
    frames = np.arange(20, 41)
    curve = spread_displacements(frames, np.ones((21, 1)), Window(5, 56))[:, 0]
    np.testing.assert_allclose(curve[15:36], 1.0, atol=1e-12)
    t = np.arange(1, 16) / 16.0
    np.testing.assert_allclose(curve[:15], t * t * (3.0 - 2.0 * t), atol=0.03)
    assert np.all(np.diff(curve[:16]) > 0.0)


def test_the_curve_is_one_smooth_spline_between_given_frames() -> None:
    curve = spread_displacements(np.array([12, 30]), np.array([[1.0], [-0.5]]), Window(0, 45))[:, 0]
    assert curve[12] == pytest.approx(1.0)
    assert curve[30] == pytest.approx(-0.5)
    assert np.abs(np.diff(curve, 3)).max() < 0.02
    assert np.abs(curve).max() < 1.2


def test_a_window_at_the_start_of_a_clip_is_open_there(walk: Motion) -> None:
    windows = windows_around(np.array([0, walk.frame_count - 1]), 10, walk.frame_count)
    assert windows == (Window(0, 11, False, True), Window(walk.frame_count - 11, walk.frame_count, True, False))
    wanted = _changed(walk, np.array([0]), (4,), 0.3)
    result = displace(walk, np.array([0]), wanted, windows[:1])
    assert quaternions.angle_between(result.rotations[0], wanted.rotations[0]).max() < 1e-9
    assert result.rotations[11:].tobytes() == walk.rotations[11:].tobytes()


def test_frames_far_apart_get_windows_of_their_own() -> None:
    assert len(windows_around(np.array([10, 50]), 10, 100)) == 2
    assert windows_around(np.array([10, 25]), 10, 100) == (Window(0, 36, False, True),)
    assert windows_around(np.array([5, 6, 9]), 0, 100) == (Window(5, 7, False, False), Window(9, 10, False, False))


def test_turns_through_half_a_turn_go_on_and_do_not_swing_back() -> None:
    frames = np.arange(10)
    still = Motion(np.zeros((10, 3)), quaternions.identity(10, 1), np.zeros((10, 0, 3)), ())
    angles = np.linspace(2.8, 3.6, 10)[:, None]
    turning = still._replace(rotations=np.asarray(quaternions.from_axis_angle((0.0, 1.0, 0.0), angles), np.float64))
    given = frames[::3]
    result = displace(still, given, turning.at_frames(given), (Window(0, 10, False, False),))
    assert quaternions.angle_between(result.rotations, turning.rotations).max() < 0.05


def test_windows_that_do_not_hold_the_frames_are_refused(walk: Motion) -> None:
    wanted = walk.at_frames(np.array([20]))
    with pytest.raises(EditError, match="contains no changed frame"):
        displace(walk, np.array([20]), wanted, (Window(30, 40),))
    with pytest.raises(EditError, match="contains no changed frame"):
        displace(walk, np.array([20]), wanted, (Window(20, 30),))
    two = walk.at_frames(np.array([20, 50]))
    with pytest.raises(EditError, match="frame 50"):
        displace(walk, np.array([20, 50]), two, (Window(10, 30),))


def test_a_thousand_given_frames_are_all_met() -> None:
    random = np.random.default_rng(0)
    values = np.cumsum(random.normal(0.0, 0.01, (1000, 30)), axis=0)
    frames = np.arange(20, 1020)
    curve = spread_displacements(frames, values, Window(5, 1036))
    np.testing.assert_allclose(curve[15:1015], values, atol=1e-11)


@pytest.mark.parametrize(
    ("frames", "window"),
    [
        ((100, 101), Window(64, 138)),
        ((0, 1), Window(0, 38, False, True)),
        ((36, 37), Window(0, 38, True, False)),
        ((100, 101), Window(64, 104, True, False)),
        ((100, 101, 140, 141), Window(64, 178)),
    ],
)
def test_a_step_between_two_given_frames_does_not_swing_out_over_their_surroundings(
    frames: tuple[int, ...], window: Window
) -> None:
    values = np.resize([0.0, 1.0], (len(frames), 1))
    curve = spread_displacements(np.array(frames), values, window)[:, 0]
    np.testing.assert_allclose(curve[np.array(frames) - window.start], values[:, 0], atol=1e-12)
    assert np.abs(curve).max() < 1.9


def test_noise_in_given_frames_does_not_swing_out_over_their_surroundings() -> None:
    values = 1.0 + 0.2 * np.random.default_rng(0).normal(size=(60, 1))
    curve = spread_displacements(np.arange(100, 160), values, Window(64, 196))[:, 0]
    np.testing.assert_allclose(curve[36:96], values[:, 0], atol=1e-11)
    assert np.abs(curve).max() < 1.1 * np.abs(values).max()


def test_a_ramp_goes_on_as_it_ends_and_turns_back_softly() -> None:
    curve = spread_displacements(np.arange(100, 136), np.linspace(0.0, 1.0, 36)[:, None], Window(64, 172))[:, 0]
    assert 1.0 <= curve.max() < 1.1
    assert np.abs(np.diff(np.concatenate((np.zeros(3), curve, np.zeros(3))), 2)).max() < 0.5 / 36
