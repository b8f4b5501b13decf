"""Rules of the controller, tested on databases of exact roots."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.plain_controller import run_plainly
from tests.support.synthetic_databases import (
    EXACT,
    arc_track,
    circle,
    database_clips,
    index_of,
    offsets,
    play,
    random_tracks,
    switches,
    synthetic_database,
)

from marey_motion.errors import MotionError
from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.matching.controller import run_trial
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions

# The loop as it is defined


@pytest.mark.parametrize("follow", ["time", "open_loop"])
@pytest.mark.parametrize(
    "options",
    [
        ControllerOptions(),
        ControllerOptions(root_inertialisation=False, continuing_bias=-0.3, reselect_window_s=0.5),
        ControllerOptions(search_every_s=1 / 60, switch_margin=0.5, half_life_s=0.3),
    ],
    ids=["default", "biased", "eager"],
)
def test_the_compiled_loop_does_what_a_plain_one_does(options: ControllerOptions, follow: str) -> None:
    database = synthetic_database(random_tracks(12, seed=5))
    options = options.replace(follow=follow)
    for trial in (circle(2.2, 60.0), Trial("switching", 1.5, -0.4, approach_s=1.05, switch_every_s=1.35)):
        record = play(database, trial, options)

        plain = run_plainly(database, reference(trial), options, 420)

        assert record.rows[:420].tolist() == plain.rows
        np.testing.assert_allclose(
            record.positions[:420, 1] + 1j * record.positions[:420, 0], plain.positions, atol=1e-9
        )
        np.testing.assert_allclose(record.headings[:420], plain.headings, atol=1e-9)
        assert np.flatnonzero(record.status[:420] == Status.REPLACING).tolist() == [
            tick + 1 for tick in plain.switches if tick < 419
        ]
        assert np.flatnonzero(np.isfinite(record.match_cost[1:420])).tolist() == [tick - 1 for tick in plain.searches]


def test_loops_and_ends_are_played_as_a_plain_loop_plays_them() -> None:
    tracks = [track._replace(loop=number % 2 == 0) for number, track in enumerate(random_tracks(5, seed=8))]
    database = synthetic_database(tracks, DatabaseOptions(end_policy="loop"))
    options = ControllerOptions(continuing_bias=-50.0)

    record = play(database, circle(2.0, 40.0), options)

    plain = run_plainly(database, reference(circle(2.0, 40.0)), options, 1980)
    assert plain.forced
    assert plain.switches
    wraps = np.isin(record.rows[1:], database.starts) & (np.diff(record.rows) < -140)
    forced = np.zeros(1980, dtype=bool)
    forced[[0, *(tick + 1 for tick in plain.forced), *(np.flatnonzero(wraps) + 1)]] = True
    assert wraps.any()
    assert record.rows.tolist() == plain.rows
    assert np.array_equal(record.status == Status.FORCED, forced)


# When it searches and what it chooses


def searched(record: TrialRecord) -> list[int]:
    return np.flatnonzero(np.isfinite(record.match_cost)).tolist()


def test_a_trial_starts_on_the_row_whose_trajectory_fits_whatever_its_pose() -> None:
    slow, fast = arc_track(1.0, 0.0, 10.0), arc_track(3.0, 0.0, 10.0)
    database = synthetic_database([slow, fast._replace(pose=fast.pose + 100.0)])

    record = play(database, circle(3.0, 0.0))

    assert record.rows[0] == database.starts[1]
    assert record.status[0] == Status.FORCED
    np.testing.assert_allclose(record.match_cost[0], 0.0, atol=1e-20)


def test_searches_come_at_multiples_of_the_period() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 60.0)])

    record = play(database, circle(2.0, 0.0, duration_s=2.0), EXACT.replace(search_every_s=0.25))

    assert searched(record) == list(range(0, 300, 15))
    assert np.all(np.isnan(record.continuing_cost) == np.isin(np.arange(300), searched(record)[1:], invert=True))


def test_a_jump_of_the_wished_speed_is_searched_for_at_once() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 60.0), arc_track(4.0, 0.0, 60.0)])
    trial = Trial("switching", 1.0, 0.0, approach_s=1.0, duration_s=4.0, switch_every_s=1.25)

    record = play(database, trial, EXACT.replace(search_every_s=0.5, follow="open_loop"))

    # The speed jumps at 2.25, 3.5 and 4.75 s.
    assert searched(record) == sorted([*range(0, 300, 30), 135, 285])
    assert record.status[136] == Status.REPLACING


@pytest.mark.parametrize(("turn_deg", "at_once"), [(29.0, []), (31.0, [100])])
def test_a_jump_of_the_wished_direction_is_searched_for_at_once_however_slow(
    turn_deg: float, at_once: list[int]
) -> None:
    database = synthetic_database([arc_track(0.3, 0.0, 60.0)])
    path = reference(circle(0.3, 0.0, duration_s=1.0))
    turned = path.headings + np.where(np.arange(len(path.headings)) >= 100, np.radians(turn_deg), 0.0)

    record = play(database, replace(path, headings=turned), EXACT.replace(search_every_s=0.5))

    assert searched(record) == sorted([*range(0, 240, 30), *at_once])


def test_jumps_are_searched_for_at_most_once_in_a_period() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 60.0), arc_track(4.0, 0.0, 60.0)])
    trial = Trial("switching", 1.0, 0.0, approach_s=1.0, duration_s=1.0, switch_every_s=5 / 60)

    record = play(database, trial, EXACT.replace(search_every_s=0.5))

    # From 65 on the speed jumps every 5 ticks.
    assert searched(record) == [0, 30, 60, 65, 90, 95]


def test_at_the_end_of_a_clip_another_row_must_be_chosen() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 5.05)])
    options = EXACT.replace(search_every_s=0.5, continuing_bias=-1000.0)

    record = play(database, circle(2.0, 0.0, duration_s=7.0), options)

    assert record.rows[302] == 302  # the last frame, no multiple of the period
    assert record.status[303] == Status.FORCED
    assert np.isnan(record.continuing_cost[302])
    assert np.isfinite(record.match_cost[302])
    assert switches(record) == 0
    assert record.status[302] == Status.KEPT


def test_a_loop_goes_round_without_being_forced_to_search() -> None:
    track = arc_track(1.0, 90.0, 4.0, loop=True)
    database = synthetic_database([track], DatabaseOptions(end_policy="loop"))
    options = EXACT.replace(follow="open_loop", continuing_bias=-1000.0)

    record = play(database, circle(1.0, 90.0, approach_s=0.0, duration_s=20.0), options)

    assert np.array_equal(record.rows, np.arange(1200) % 240)
    assert np.flatnonzero(record.status == Status.FORCED).tolist() == [0, 240, 480, 720, 960]
    assert switches(record) == 0
    trial = circle(1.0, 90.0, approach_s=0.0, duration_s=20.0)
    assert offsets(record, trial).max() < 1e-9


def test_a_clip_not_marked_as_a_loop_ends_even_where_loops_go_round() -> None:
    database = synthetic_database([arc_track(1.0, 90.0, 4.0)], DatabaseOptions(end_policy="loop"))

    record = play(database, circle(1.0, 90.0, approach_s=0.0), EXACT.replace(continuing_bias=-1000.0))

    assert np.isnan(record.continuing_cost[239])
    assert record.status[240] == Status.FORCED


def test_going_on_wins_unless_a_switch_is_cheaper_by_more_than_the_margin() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 60.0), arc_track(2.0, 50.0, 60.0)])
    trial = circle(2.0, 50.0)
    eager = play(database, trial, EXACT.replace(follow="open_loop"))
    assert switches(eager) >= 1
    first = int(np.flatnonzero(eager.status == Status.REPLACING)[0]) - 1
    gain = eager.continuing_cost[first] - eager.match_cost[first]
    assert gain > 0.0

    just_enough = play(database, trial, EXACT.replace(follow="open_loop", switch_margin=0.999 * gain))
    too_much = play(database, trial, EXACT.replace(follow="open_loop", switch_margin=1.001 * gain))

    assert just_enough.status[first + 1] == Status.REPLACING
    assert too_much.status[first + 1] == Status.KEPT
    assert too_much.match_cost[first] == too_much.continuing_cost[first]


def test_a_bias_towards_going_on_is_a_margin_and_its_opposite_makes_restless() -> None:
    database = synthetic_database(random_tracks(20, seed=7))
    trial = circle(2.0, 60.0)

    margin = play(database, trial, EXACT.replace(switch_margin=0.5))
    bias = play(database, trial, EXACT.replace(switch_margin=0.0, continuing_bias=-0.5))
    restless = play(database, trial, EXACT.replace(continuing_bias=0.5))

    assert np.array_equal(margin.rows, bias.rows)
    assert switches(margin) < switches(play(database, trial)) <= switches(restless)


def test_rows_near_the_current_one_are_left_out_of_the_search_on_request() -> None:
    database = synthetic_database(random_tracks(12, seed=9))
    trial = circle(2.0, 60.0)

    free = play(database, trial, EXACT)
    apart = play(database, trial, EXACT.replace(reselect_window_s=1 / 3))

    def nearest_switch(record: TrialRecord) -> int:
        ticks = np.flatnonzero(record.status == Status.REPLACING)
        before, after = record.rows[ticks - 1], record.rows[ticks] - 1
        same = database_clips(database, before) == database_clips(database, after)
        return int(np.abs(after - before)[same].min(initial=10**6))

    assert nearest_switch(free) <= 20 < nearest_switch(apart)


@pytest.mark.parametrize(
    ("choosable", "chosen"),
    [((195, 196, 216, 217), 195), ((196, 216, 217), 217), ((196, 197, 401), 401), ((196, 217), 196)],
    ids=["before", "after", "far away", "in the clip before"],
)
def test_the_window_bars_as_many_frames_on_either_side_and_none_of_another_clip(
    choosable: tuple[Any, ...], chosen: int
) -> None:
    """Rows up to ten frames before and after row 206 may not be chosen.

    All rows cost the same, so the first allowed row is chosen.
    """
    first = 199 if chosen == 196 else 190
    database = synthetic_database([arc_track(2.0, 0.0, frames / 60) for frames in (first, 600 - first)])
    features = np.ones_like(database.features)
    features[200, 15:] = database.features[200, 15:]
    selectable = np.isin(np.arange(600), [200, *choosable])
    database = replace(database, features=features, selectable=selectable)

    record = play(database, circle(2.0, 0.0), EXACT.replace(reselect_window_s=1 / 6, continuing_bias=1000.0))

    assert record.rows[:8].tolist() == [*range(200, 207), chosen + 1]


def test_a_window_wider_than_the_whole_dataset_still_leaves_a_way_on() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 4.0)])

    record = play(database, circle(2.0, 0.0), EXACT.replace(reselect_window_s=10.0))

    assert record.rows[:240].tolist() == list(range(240))
    assert record.status[240] == Status.FORCED


def test_among_equal_rows_the_lowest_is_chosen() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 10.0, uid=uid) for uid in ("b", "a", "c")])

    assert play(database, circle(2.0, 0.0)).rows[0] == 0


# The paper's literal cost


def test_by_pose_distance_the_cost_is_metres_over_the_pose_joints_beside_the_trajectory() -> None:
    database = synthetic_database(random_tracks(12, seed=11))
    trial = circle(2.0, 60.0, duration_s=4.0)

    record = play(database, trial, EXACT.replace(selection="pose_distance"))

    tick = int(np.flatnonzero(record.status == Status.REPLACING)[0]) - 1
    row, chosen = record.rows[tick], record.rows[tick + 1] - 1
    points = database.pose_points.astype(np.float64)
    distances = np.linalg.norm(points - points[row], axis=-1).sum(axis=-1)
    costs = distances + trajectory_costs(database, record, reference(trial), tick)
    costs[~database.selectable] = np.inf
    assert chosen == np.argmin(costs)
    np.testing.assert_allclose(record.match_cost[tick], costs[chosen], rtol=1e-12)


def trajectory_costs(database: MatchingDatabase, record: TrialRecord, path: Reference, tick: int) -> np.ndarray:
    ahead = tick + np.array([20, 40, 60])
    sine, cosine = np.sin(record.headings[tick]), np.cos(record.headings[tick])
    x, z = (path.positions[ahead] - record.positions[tick]).T
    turn = path.headings[ahead] - record.headings[tick]
    places = np.stack((x * cosine - z * sine, x * sine + z * cosine), axis=1)
    raw = np.concatenate((places.ravel(), np.stack((np.sin(turn), np.cos(turn)), axis=1).ravel()))
    return (((database.features[:, 15:] - raw) / database.normaliser.scale[15:]) ** 2).sum(axis=1)


# The root


def test_blended_root_velocity_does_not_jump_at_a_switch() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 60.0), arc_track(4.0, 0.0, 60.0)])
    trial = Trial("switching", 1.0, 0.0, approach_s=1.0, duration_s=4.0, switch_every_s=2.0)

    plain = play(database, trial, EXACT.replace(follow="open_loop"))
    blended = play(database, trial, ControllerOptions(follow="open_loop"))

    def speeds(record: TrialRecord) -> np.ndarray:
        return np.linalg.norm(np.diff(record.positions, axis=0), axis=1) * 60

    tick = int(np.flatnonzero(blended.status == Status.REPLACING)[0])
    assert np.abs(np.diff(speeds(plain))).max() > 2.99
    assert abs(speeds(blended)[tick - 1] - 1.0) < 1e-9  # the first step of the new clip, at the old one's speed
    y = 2 * np.log(2) / 0.1
    elapsed = np.arange(60) / 60
    expected = 4.0 - 3.0 * np.exp(-y * elapsed) * (1 + y * elapsed)
    np.testing.assert_allclose(speeds(blended)[tick - 1 : tick + 59], expected, atol=1e-9)


def test_a_pull_towards_the_reference_and_a_clamp_keep_the_character_near() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 60.0)])
    trial = circle(1.0, 50.0)

    free = offsets(play(database, trial), trial).max()
    pulled = offsets(play(database, trial, EXACT.replace(root_adjustment=1.0)), trial).max()
    clamped = offsets(play(database, trial, EXACT.replace(root_clamp_m=0.25)), trial).max()

    assert free > 1.0
    assert pulled < 0.9 * free
    assert abs(clamped - 0.25) < 1e-9


def test_a_pull_turns_the_character_the_short_way_round() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 60.0)])
    path = reference(circle(1.0, 50.0))
    rounds = replace(path, headings=path.headings + np.where(np.arange(len(path.headings)) > 0, 4 * np.pi, 0.0))
    options = EXACT.replace(root_adjustment=1.0, continuing_bias=-1000.0)

    record, wound = play(database, path, options), play(database, rounds, options)

    assert record.headings[-1] > np.radians(50.0) * 28.0
    np.testing.assert_allclose(wound.headings, record.headings, atol=1e-9)


# Following a path


def test_following_the_path_a_slow_character_is_not_hurried_along() -> None:
    database = synthetic_database([arc_track(1.0, w, 60.0) for w in (-60.0, -30.0, 0.0, 30.0, 60.0)])
    trial = circle(2.0, 30.0)

    by_time = play(database, trial, EXACT)
    by_path = play(database, trial, EXACT.replace(follow="path"))

    def distance_to_path(record: TrialRecord) -> float:
        path = reference(trial).positions
        return float(np.linalg.norm(record.positions[:, None] - path[None], axis=-1).min(axis=1).max())

    assert distance_to_path(by_path) < 0.5
    assert distance_to_path(by_time) > 3.0


def test_the_path_is_looked_at_from_the_nearest_point_also_where_that_lies_between_two_ticks() -> None:
    """The root moves at 0.9 m/s parallel to a straight path; the requested speed is 2 m/s.

    So the requested points, relative to the root, must be the same at every tick.
    """
    database = synthetic_database([arc_track(0.9, 0.0, 60.0)])
    path = reference(circle(2.0, 0.0, duration_s=1.0))
    beside = path.positions + np.array([0.25, 0.0])
    beside[0] = path.positions[0]  # where the character begins
    options = EXACT.replace(follow="path", search_every_s=1 / 60, continuing_bias=-1000.0)

    record = play(database, replace(path, positions=beside), options)

    ahead = [[0.25, 2.0 * seconds] for seconds in (1 / 3, 2 / 3, 1.0)]
    wanted = np.concatenate((np.ravel(ahead), [0.0, 1.0] * 3))
    expected = (((database.features[0, 15:] - wanted) / database.normaliser.scale[15:]) ** 2).sum()
    np.testing.assert_allclose(record.continuing_cost[30:], expected, rtol=1e-9)


def test_a_character_faster_than_the_path_goes_on_round_it_past_its_end() -> None:
    database = synthetic_database([arc_track(3.0, w, 60.0) for w in (0.0, 45.0, 90.0, 135.0)])
    trial = circle(1.5, 45.0, duration_s=20.0)

    record = play(database, trial, EXACT.replace(follow="path"))

    centre = np.array([1.5 / np.radians(45), 4.5])
    radius = np.linalg.norm(record.positions[240:] - centre, axis=1)
    assert np.abs(radius - 1.5 / np.radians(45)).max() < 1.0
    assert record.headings[-1] > 1.3 * np.radians(45) * 20.0


# What cannot be played


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"search_every_s": 0.0}, "search_every_s"),
        ({"half_life_s": 0.0}, "half_life_s"),
        ({"switch_margin": -0.1}, "switch_margin"),
        ({"reselect_window_s": -1.0}, "reselect_window_s"),
        ({"root_adjustment": -1.0}, "root_adjustment"),
        ({"root_clamp_m": -1.0}, "root_clamp_m"),
        ({"continuing_bias": float("nan")}, "finite"),
    ],
)
def test_options_that_make_no_sense_are_named(options: dict[str, float], where: str) -> None:
    with pytest.raises(ValidationError, match=where):
        EXACT.replace(**options)


@pytest.mark.parametrize("period_s", [0.004, 0.5 / 60])
def test_a_search_period_that_rounds_to_no_tick_is_refused(period_s: float) -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 5.0)])

    with pytest.raises(MotionError, match="search_every_s: the period of searches"):
        play(database, circle(1.0, 0.0), EXACT.replace(search_every_s=period_s))


def test_a_trajectory_of_another_rate_is_refused() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 5.0)])

    with pytest.raises(MotionError, match="30 ticks per second, but the database has 60"):
        play(database, reference(circle(1.0, 0.0), rate_hz=30.0))


def test_an_index_of_other_rows_is_refused() -> None:
    database, other = synthetic_database([arc_track(1.0, 0.0, 5.0)]), synthetic_database([arc_track(1.0, 0.0, 6.0)])

    with pytest.raises(MotionError, match="360 rows, but the database has 300"):
        run_trial(database, index_of(other), reference(circle(1.0, 0.0)), EXACT)


def test_a_row_that_nothing_follows_may_not_be_choosable() -> None:
    database = synthetic_database([arc_track(1.0, 0.0, 5.0)])
    everything = replace(database, selectable=np.ones(300, dtype=bool))

    with pytest.raises(MotionError, match="row 299"):
        play(everything, circle(1.0, 0.0))
