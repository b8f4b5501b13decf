from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_cases import RATE_HZ, arc, root_database

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import (
    cell_edges,
    measure_coverage,
    sliding_windows,
)
from marey_schemas.options.evaluation import EvaluationOptions

OPTIONS = EvaluationOptions()


def mirrored(root: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    positions, headings = root
    return positions * (-1.0, 1.0), -headings


def side_step(speed_m_s: float, duration_s: float, *, towards_deg: float) -> tuple[Floats, Floats]:
    """Return positions and headings of a root that faces +z and moves in the direction `towards_deg`."""
    times = np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ
    direction = np.array([np.sin(np.radians(towards_deg)), np.cos(np.radians(towards_deg))])
    return speed_m_s * times[:, None] * direction, np.zeros_like(times)


def test_every_window_of_a_circle_is_at_its_speed_and_turn_rate() -> None:
    coverage = measure_coverage(root_database(arc(2.0, 50.0, 10.0)), OPTIONS)

    assert len(coverage.speed_m_s) == 541
    assert coverage.speed_m_s == pytest.approx(2.0, abs=1e-3)
    assert np.degrees(coverage.turn_rate_rad_s) == pytest.approx(50.0, abs=1e-3)
    assert coverage.forward_m_s == pytest.approx(2.0, abs=1e-3)
    assert coverage.strafe_m_s == pytest.approx(0.0, abs=1e-9)
    assert coverage.clip.tolist() == [0] * 541


def test_no_window_lies_across_two_clips() -> None:
    slow, fast = arc(1.0, 0.0, 3.0), arc(3.0, 0.0, 3.0)
    coverage = measure_coverage(root_database(slow, fast), OPTIONS)

    assert len(coverage.speed_m_s) == 2 * (181 - 60)
    assert coverage.speed_m_s[coverage.clip == 0] == pytest.approx(1.0)
    assert coverage.speed_m_s[coverage.clip == 1] == pytest.approx(3.0)


def test_a_clip_of_a_second_or_less_is_listed_as_too_short() -> None:
    shortest = arc(1.0, 0.0, 59 / RATE_HZ)  # sixty frames, fifty-nine steps
    coverage = measure_coverage(root_database(shortest, arc(1.0, 0.0, 1.0), arc(1.0, 0.0, 2.0)), OPTIONS)

    assert coverage.too_short == (0,)
    assert coverage.clip.tolist() == [1] + [2] * 61


def test_clips_that_walk_in_place_are_left_out() -> None:
    database = root_database(arc(0.05, 0.0, 2.0), arc(2.0, 0.0, 2.0), arc(0.05, 0.0, 0.5))
    walking, travelling, stepping = database.clips
    database = replace(database, clips=(replace(walking, in_place=True), travelling, replace(stepping, in_place=True)))
    coverage = measure_coverage(database, OPTIONS)

    assert set(coverage.clip.tolist()) == {1}
    assert coverage.too_short == ()


def test_a_database_without_a_second_of_motion_covers_nothing() -> None:
    coverage = measure_coverage(root_database(arc(1.0, 0.0, 0.5)), OPTIONS)

    assert coverage.seconds.sum() == 0.0
    assert coverage.index == 0.0
    assert coverage.deficit_s == pytest.approx(1.0)


def test_every_trial_owns_the_cell_around_it() -> None:
    clips = [arc(v, w, 3.0) for v in OPTIONS.speeds_m_s for w in OPTIONS.turn_rates_deg_s]
    coverage = measure_coverage(root_database(*clips), OPTIONS)

    assert coverage.seconds.shape == (9, 9)
    assert coverage.seconds == pytest.approx(121 / RATE_HZ)
    assert coverage.index == 1.0
    assert not coverage.deficit_s.any()
    assert coverage.speed_edges_m_s[[0, 1, -1]] == pytest.approx([0.875, 1.125, 3.125])
    assert coverage.turn_rate_edges_deg_s[[0, 1, -1]] == pytest.approx([-112.5, -87.5, 112.5])


def test_what_is_faster_than_any_trial_is_a_window_without_a_cell() -> None:
    coverage = measure_coverage(root_database(arc(4.0, 0.0, 3.0)), OPTIONS)

    assert len(coverage.speed_m_s) == 121
    assert coverage.seconds.sum() == 0.0


def test_cells_say_how_much_they_lack() -> None:
    options = EvaluationOptions(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(-50.0, 0.0), coverage_least_s=2.0)
    half = 0.5 * RATE_HZ - 1  # windows besides the first, for half a second in all
    root = root_database(arc(1.0, 0.0, 3.0 - 1 / RATE_HZ), arc(2.0, -50.0, 1.0 + half / RATE_HZ))
    coverage = measure_coverage(root, options)

    assert coverage.deficit_s == pytest.approx(np.array([[2.0, 0.0], [1.5, 2.0]]))
    assert coverage.index == 0.25


def test_a_mirror_closed_set_is_symmetric_and_a_one_sided_one_is_not() -> None:
    left = [arc(v, w, 4.0) for v in (1.0, 2.0) for w in (30.0, 50.0, 75.0)]
    right = [mirrored(root) for root in left]

    assert measure_coverage(root_database(*left, *right), OPTIONS).symmetry == 1.0
    assert measure_coverage(root_database(*left), OPTIONS).symmetry == 0.0
    assert measure_coverage(root_database(*right), OPTIONS).symmetry == 0.0


def test_symmetry_lies_between_for_a_set_that_turns_more_to_one_side() -> None:
    three, one = arc(2.0, 50.0, 4.0), mirrored(arc(2.0, 50.0, 2.0))

    assert measure_coverage(root_database(three, one), OPTIONS).symmetry == pytest.approx(1 - 120 / 242)


def test_seconds_that_are_enough_to_the_frame_leave_no_hole() -> None:
    enough = OPTIONS.replace(speeds_m_s=(1.0,), turn_rates_deg_s=(0.0,), coverage_least_s=1.85)
    for windows, holes in ((110, 1), (111, 0)):
        coverage = measure_coverage(root_database(arc(1.0, 0.0, (windows + 59) / RATE_HZ)), enough)
        assert len(coverage.speed_m_s) == windows
        assert np.count_nonzero(coverage.deficit_s) == holes


def test_what_goes_straight_or_nearly_so_counts_as_alike_on_both_sides() -> None:
    left, straight, nearly = arc(2.0, 50.0, 4.0), arc(2.0, 0.0, 4.0), arc(2.0, 5.0, 4.0)

    assert measure_coverage(root_database(left, straight), OPTIONS).symmetry == pytest.approx(0.5)
    assert measure_coverage(root_database(left, nearly), OPTIONS).symmetry == pytest.approx(0.5)


def test_turn_rates_on_the_edge_of_a_cell_mirror_each_other() -> None:
    on_the_edge = arc(2.0, 37.5, 4.0)

    assert measure_coverage(root_database(on_the_edge, mirrored(on_the_edge)), OPTIONS).symmetry == 1.0


def test_going_straight_is_symmetric() -> None:
    assert measure_coverage(root_database(arc(1.0, 0.0, 4.0)), OPTIONS).symmetry == 1.0


@pytest.mark.parametrize("turn_rates", [(0.0, 50.0, 100.0), (50.0, 100.0), (-100.0, -50.0), (-50.0, 50.0)])
def test_symmetry_does_not_depend_on_a_grid_that_looks_to_one_side(turn_rates: tuple[Any, ...]) -> None:
    options = EvaluationOptions(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=turn_rates)
    left = arc(1.0, 50.0, 4.0)

    assert measure_coverage(root_database(left, mirrored(left)), options).symmetry == 1.0
    assert measure_coverage(root_database(left), options).symmetry == 0.0


def test_backward_and_side_steps_have_their_own_signed_channels() -> None:
    backward = side_step(1.0, 2.0, towards_deg=180.0)
    leftward = side_step(0.5, 2.0, towards_deg=90.0)
    coverage = measure_coverage(root_database(backward, leftward), OPTIONS)
    first, second = coverage.clip == 0, coverage.clip == 1

    assert coverage.speed_m_s[first] == pytest.approx(1.0)
    assert coverage.forward_m_s[first] == pytest.approx(-1.0)
    assert coverage.speed_m_s[second] == pytest.approx(0.5)
    assert coverage.strafe_m_s[second] == pytest.approx(0.5)
    assert coverage.forward_m_s[second] == pytest.approx(0.0, abs=1e-12)


def test_speed_is_the_length_of_the_way_not_the_distance_covered() -> None:
    times = np.arange(121) / RATE_HZ
    there_and_back = np.stack((np.zeros(121), np.abs(times - 1.0)), axis=1)
    windows = sliding_windows(there_and_back, np.zeros(121), RATE_HZ)

    assert windows.speed_m_s == pytest.approx(1.0)
    assert windows.forward_m_s[30] == pytest.approx(0.0, abs=1e-9)


def test_windows_are_a_second_long_at_any_rate() -> None:
    positions = np.stack((np.zeros(91), np.arange(91.0) * 0.05), axis=1)
    windows = sliding_windows(positions, np.zeros(91), 30.0)

    assert len(windows.speed_m_s) == 61
    assert windows.speed_m_s == pytest.approx(1.5)


def test_a_single_speed_has_a_cell_of_the_usual_width() -> None:
    assert cell_edges((1.5,), 0.25) == pytest.approx([1.375, 1.625])
    assert cell_edges((3.0, 1.0, 2.0), 0.25) == pytest.approx([0.5, 1.5, 2.5, 3.5])
    with pytest.raises(MotionError, match="at least one speed"):
        cell_edges((), 0.25)
