"""Time functions (time warps), which are computed from alignment paths, inverted, and applied to motions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.support.alignment_examples import played, sine_warp, walk

from marey_motion.alignment.dtw import align
from marey_motion.alignment.warp import LEAST_SLOPE, inverse, time_function, warped
from marey_motion.arrays import Floats, Ints32
from marey_motion.errors import MotionError
from marey_motion.motion import Motion


@st.composite
def paths(draw: Callable[..., Any]) -> Ints32:
    """Draw alignment paths of allowed steps through at least two frames of each motion.

    Most paths have at most three steps in a row that advance in only one motion.
    """
    steps = draw(st.lists(st.sampled_from(["11", "11", "10", "01", "110", "1000", "0001", "01111"]), min_size=1))
    moves = {"11": [(1, 1)], "10": [(1, 0), (1, 1)], "01": [(0, 1), (1, 1)]}
    cells = [(0, 0)]
    for step in steps:
        found = moves.get(step) or [(1, 0) if digit == "0" else (0, 1) for digit in step] + [(1, 1)]
        for i, j in found:
            cells.append((cells[-1][0] + i, cells[-1][1] + j))
    return np.array(cells, dtype=np.int32)


@given(paths())
def test_a_time_function_rises_strictly_from_the_first_to_the_last_frame_of_the_source(path: Ints32) -> None:
    times = time_function(path)
    assert len(times) == path[-1, 0] + 1
    assert times[0] == 0.0
    assert times[-1] == path[-1, 1]
    assert np.diff(times).min() >= LEAST_SLOPE


@given(paths())
def test_a_time_function_stays_within_half_a_run_of_the_path(path: Ints32) -> None:
    times = time_function(path)
    for frame, time in enumerate(times):
        matched = path[path[:, 0] == frame, 1]
        sides = path[np.isin(path[:, 1], matched), 0]
        reach = 1.0 + (sides.max() - sides.min() + 1) / 2 + len(matched) / 2
        assert abs(time - matched.mean()) <= reach


def test_frames_matched_one_to_one_are_the_identity() -> None:
    path = np.stack([np.arange(9)] * 2, axis=1)
    assert time_function(path).tolist() == list(range(9))


def test_a_frame_matched_with_several_belongs_to_their_mean() -> None:
    path = np.array([(0, 0), (1, 1), (1, 2), (1, 3), (2, 4), (3, 5)])
    assert time_function(path).tolist() == [0.0, 2.0, 4.0, 5.0]


def test_frames_that_share_one_source_frame_lie_evenly_around_it() -> None:
    path = np.array([(0, 0), (1, 1), (2, 1), (3, 1), (4, 2), (5, 3)])
    times = time_function(path)
    assert times[2] == 1.0
    assert np.diff(times).min() >= 0.5
    assert (times[1], times[3]) == pytest.approx((0.5, 1.5))


def test_a_section_that_begins_elsewhere_keeps_its_frames() -> None:
    path = np.array([(4, 7), (5, 8), (6, 9)])
    assert time_function(path).tolist() == [7.0, 8.0, 9.0]


def test_slopes_that_are_too_small_are_raised_and_the_others_give_way_alike() -> None:
    long_run = [(frame, 1) for frame in range(1, 60)]
    path = np.array([(0, 0), *long_run, (60, 2), (61, 3), (62, 4)])
    steps = np.diff(time_function(path))
    assert steps.min() == pytest.approx(LEAST_SLOPE, rel=1e-4) or steps.min() > LEAST_SLOPE
    assert steps.sum() == pytest.approx(4.0)


def test_a_source_without_the_time_for_the_least_slopes_is_refused() -> None:
    path = np.array([*((frame, 0) for frame in range(300)), (300, 1)])
    with pytest.raises(MotionError, match="cannot be aligned with 1 frames of the source"):
        time_function(path)
    with pytest.raises(MotionError, match="two frames in both"):
        time_function(np.array([(0, 0), (1, 0)]))


@given(
    arrays(np.float64, st.integers(3, 60), elements=st.floats(0.02, 4.0)),
)
def test_inverting_and_applying_a_time_function_is_the_identity(slopes: Floats) -> None:
    times = np.concatenate(([0.0], np.cumsum(slopes)))
    times *= max(1, round(times[-1])) / times[-1]
    back = inverse(times)
    assert len(back) == round(times[-1]) + 1
    assert np.interp(back, np.arange(len(times)), times) == pytest.approx(np.arange(len(back)), abs=1e-9)


def test_the_identity_gives_every_bit_of_the_motion_back() -> None:
    motion = Motion.of(walk())
    same = warped(motion, np.arange(motion.frame_count, dtype=float))
    assert same.poses.tobytes() == motion.poses.tobytes()


def test_a_motion_is_played_by_its_time_function_with_slerp_between_frames() -> None:
    clip, times = walk(), sine_warp(60, 47)
    expected = played(clip, times)
    found = warped(Motion.of(clip), times)
    turns = np.abs(np.einsum("fjc,fjc->fj", found.rotations, expected.rotations))
    assert turns.min() > 1.0 - 1e-6
    assert found.root_translations == pytest.approx(expected.root_translations, abs=1e-6)
    assert np.linalg.norm(found.rotations, axis=-1) == pytest.approx(1.0, abs=1e-12)


def test_translations_of_joints_are_played_along() -> None:
    motion = Motion.of(walk())
    moving = np.linspace(0.0, 1.0, 60)[:, None, None] * np.array([0.0, 0.1, 0.0])
    found = warped(motion._replace(translations=moving, translated_joints=(3,)), [0.0, 29.5, 59.0])
    assert found.translations[:, 0, 1] == pytest.approx([0.0, 0.05, 0.1])
    assert found.translated_joints == (3,)


def test_times_that_the_motion_does_not_have_are_refused() -> None:
    with pytest.raises(MotionError, match="whose frames are 0 to 59"):
        warped(Motion.of(walk()), [0.0, 59.5])


def test_a_way_through_costs_becomes_a_function_of_the_warp_within_a_frame() -> None:
    truth = sine_warp(60, 75, 0.08)
    places = np.linspace(0.0, 6.0, 60)
    costs = (np.interp(truth, np.arange(60), places)[None] - places[:, None]) ** 2
    times = time_function(align(costs, max_run=3).path)
    assert np.abs(np.interp(np.arange(75), times, np.arange(60)) - truth).max() < 1.0
