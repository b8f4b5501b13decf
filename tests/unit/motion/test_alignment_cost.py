"""The closed-form cost, compared with numeric minimisation and plain loops, and tests of former defects."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from marey_motion.alignment.cost import frame_costs
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_schemas.options.alignment import AlignOptions, CostMethod, CostOptions

POINTS = 9


def cloud(frames: int, seed: int, points: int = POINTS) -> Floats:
    """Return points (frames, points, 3) of a body that wanders over the ground."""
    random = np.random.default_rng(seed)
    return (
        random.normal(size=(frames, points, 3)) * 0.4 + random.normal(size=(frames, 1, 3)) + np.array((2.0, 1.0, -5.0))
    )


def on_the_ground(points: Floats, turn_rad: float, x: float, z: float) -> Floats:
    turned = Rotation.from_euler("y", turn_rad).apply(points.reshape(-1, 3)).reshape(points.shape)
    return turned + np.array((x, 0.0, z))


def minimised(a: Floats, b: Floats, weights: Floats) -> float:
    """Return the weighted mean of squared distances between points a and b (P, 3) after the best turn and shift.

    A numeric search finds the turn about the vertical and the shift on the ground.
    """
    shares = weights / weights.sum()

    def cost(parameters: Floats) -> float:
        return float(shares @ ((a - on_the_ground(b, *parameters)) ** 2).sum(axis=1))

    starts = [(turn, *(shares @ (a - on_the_ground(b, turn, 0.0, 0.0)))[[0, 2]]) for turn in np.arange(8) * np.pi / 4]
    found = [minimize(cost, start, method="BFGS", options={"gtol": 1e-11}).fun for start in starts]
    return min(found)


def test_the_closed_form_is_what_minimising_over_turns_and_shifts_finds() -> None:
    weights = np.random.default_rng(1).uniform(0.2, 3.0, POINTS)
    a, b = cloud(2, 2), cloud(3, 3)
    costs = frame_costs(a, b, weights=weights)
    expected = [[minimised(one, other, weights) for other in b] for one in a]
    assert costs == pytest.approx(np.array(expected), abs=1e-9)


@pytest.mark.parametrize("angle_deg", [10, 45, 90, 180])
def test_a_pose_costs_nothing_against_itself_turned_and_moved_on_the_ground(angle_deg: int) -> None:
    a = cloud(3, 4)
    b = on_the_ground(a, np.radians(angle_deg), 3.0, -7.0)
    assert np.diagonal(frame_costs(a, b)) == pytest.approx(np.zeros(3), abs=1e-12)


@given(st.floats(-10, 10), st.floats(-20, 20), st.floats(-20, 20), st.integers(0, 1000))
def test_no_turn_and_no_shift_on_the_ground_changes_a_cost(turn_rad: float, x: float, z: float, seed: int) -> None:
    a, b = cloud(3, seed), cloud(2, seed + 1)
    assert frame_costs(a, on_the_ground(b, turn_rad, x, z)) == pytest.approx(frame_costs(a, b), abs=1e-9)


def test_heights_count_as_they_are() -> None:
    a = cloud(1, 5)
    assert frame_costs(a, a + np.array((0.0, 0.3, 0.0)))[0, 0] == pytest.approx(0.09, abs=1e-12)


def test_costs_are_means_over_points_in_square_metres() -> None:
    a = np.zeros((1, 4, 3))
    b = a.copy()
    b[0, 0] = (0.0, 0.2, 0.0)
    assert frame_costs(a, b)[0, 0] == pytest.approx(0.04 / 4)
    assert frame_costs(a, b, weights=(3, 0, 0, 1))[0, 0] == pytest.approx(0.04 * 3 / 4)
    assert frame_costs(a, b, weights=(300, 0, 0, 100))[0, 0] == pytest.approx(0.04 * 3 / 4)


def test_plain_costs_keep_turns_and_shifts() -> None:
    a, b = cloud(3, 6), cloud(4, 7)
    expected = ((a[:, None] - b[None]) ** 2).sum(axis=-1).mean(axis=-1)
    assert frame_costs(a, b, CostOptions(cost="plain")) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("method", ["turned", "plain"])
@pytest.mark.parametrize("window", [3, 5])
def test_a_window_compares_the_frames_around_as_one_cloud(method: CostMethod, window: int) -> None:
    a, b = cloud(7, 8), cloud(6, 9)
    around = window // 2

    def clouds(points: Floats) -> Floats:
        frames = np.arange(len(points))[:, None] + np.arange(-around, around + 1)
        return points[np.clip(frames, 0, len(points) - 1)].reshape(len(points), -1, 3)

    weights = np.random.default_rng(10).uniform(0.1, 1.0, POINTS)
    expected = frame_costs(clouds(a), clouds(b), CostOptions(cost=method), np.tile(weights, window))
    costs = frame_costs(a, b, CostOptions(cost=method, window=window), weights)
    assert costs == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_no_cost_is_negative_where_rounding_could_make_it_so() -> None:
    a = cloud(1, 11) + np.array((1e4, 0.0, 1e4))
    for window in (1, 5):
        assert frame_costs(a, a, CostOptions(window=window))[0, 0] >= 0.0


def test_both_directions_cost_the_same() -> None:
    a, b = cloud(6, 12), cloud(4, 13)
    assert frame_costs(a, b) == pytest.approx(frame_costs(b, a).T, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"a": np.zeros((3, 4, 2))}, "must have the shape"),
        ({"b": np.zeros((3, 5, 3))}, "same number of points"),
        ({"a": np.full((3, 4, 3), np.nan)}, "frame 0: a position is infinite or not a number"),
        ({"weights": (1, 2)}, "weights: .* one weight for each of 4 points"),
        ({"weights": (1, 1, 1, -1)}, "at least 0"),
        ({"weights": (0, 0, 0, 0)}, "at least one must be above 0"),
    ],
)
def test_what_makes_no_cost_is_refused(arguments: dict[str, Any], said: str) -> None:
    given: dict[str, Any] = {"a": np.zeros((3, 4, 3)), "b": np.zeros((3, 4, 3)), **arguments}
    with pytest.raises(MotionError, match=said):
        frame_costs(**given)


@pytest.mark.parametrize(
    ("option", "value"),
    [("window", 4), ("window", 63), ("cost", "best"), ("rate_hz", float("nan")), ("rate_hz", 0.0), ("slope_limit", -1)],
)
def test_options_out_of_range_are_refused_by_name(option: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=option):
        AlignOptions(**{option: value})
