"""Explanations of the choices of motion matching."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.present import present
from tests.support.synthetic_databases import arc_track, index_of, random_tracks, synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.scenario import Trial, reference
from marey_motion.matching.controller import run_trial
from marey_motion.matching.explain import Explanation, explain_choice
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.matching import ControllerOptions

DATABASE = synthetic_database(random_tracks(12, seed=21))
INDEX = index_of(DATABASE)
PATH = reference(Trial("circle", 2.0, 1.0, duration_s=10.0))


def played(**options: Any) -> tuple[ControllerOptions, TrialRecord]:
    chosen = ControllerOptions(**options)
    return chosen, run_trial(DATABASE, INDEX, PATH, chosen)


def explained(made: tuple[ControllerOptions, TrialRecord], tick: int, **asked: Any) -> Explanation:
    options, record = made
    return explain_choice(DATABASE, INDEX, PATH, options, record, tick, **asked)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"follow": "path"},
        {"follow": "path", "root_adjustment": 1.0},
        {"follow": "open_loop"},
        {"selection": "pose_distance"},
        {"reselect_window_s": 0.3},
    ],
    ids=str,
)
def test_every_decision_of_a_trial_is_explained_as_it_was_made(options: dict[str, Any]) -> None:
    made = played(**options)
    record = made[1]
    for tick in range(0, 600, 6):
        explanation = explained(made, tick, count=3)

        following = int(record.rows[tick + 1])
        assert explanation.shown == record.rows[tick]
        assert explanation.chosen + 1 == following
        if tick > 0:
            switched = record.status[tick + 1] == Status.REPLACING
            assert explanation.reason == ("switched" if switched else "continued")
            np.testing.assert_allclose(present(explanation.going_on).cost, record.continuing_cost[tick], rtol=1e-12)
            if switched:
                assert explanation.candidates[0].row == explanation.chosen
                np.testing.assert_allclose(explanation.candidates[0].cost, record.match_cost[tick], rtol=1e-12)


def test_candidates_are_the_cheapest_rows_in_order_with_what_each_group_costs() -> None:
    explanation = explained(played(), 60, count=8)

    costs = [candidate.cost for candidate in explanation.candidates]
    assert len(costs) == 8
    assert costs == sorted(costs)
    for candidate in explanation.candidates:
        clip = DATABASE.clips[candidate.clip]
        assert candidate.row == clip.start + candidate.frame < clip.stop
        assert candidate.barred is None
        assert list(candidate.groups) == [group.name for group in DATABASE.layout.groups]
        np.testing.assert_allclose(sum(candidate.groups.values()), candidate.cost, rtol=1e-12)


def test_going_on_costs_its_trajectory_only() -> None:
    groups = present(explained(played(), 60).going_on).groups

    assert all(cost == 0.0 for name, cost in groups.items() if not name.startswith("trajectory"))
    assert groups["trajectory_positions"] > 0.0


def test_by_pose_distance_the_metres_are_a_group_of_their_own() -> None:
    explanation = explained(played(selection="pose_distance"), 60)

    assert list(explanation.candidates[0].groups) == ["pose_distance", "trajectory_positions", "trajectory_directions"]
    assert present(explanation.going_on).groups["pose_distance"] == 0.0


def test_the_start_is_explained_by_the_trajectory_alone() -> None:
    made = played()

    start = explained(made, 0)

    assert start.reason == "started"
    assert start.chosen == start.candidates[0].row == made[1].rows[0]
    assert start.going_on is None
    assert set(start.candidates[0].groups) == {"trajectory_positions", "trajectory_directions"}
    assert "started" in start.sentence


def test_between_searches_the_clip_just_goes_on() -> None:
    explanation = explained(played(), 61)

    assert explanation.reason == "not_searched"
    assert explanation.chosen == explanation.shown
    assert len(explanation.candidates) == 10


def test_the_end_of_a_clip_leaves_nothing_to_go_on() -> None:
    database = synthetic_database([arc_track(2.0, 0.0, 5.0)])
    options = ControllerOptions(continuing_bias=-1000.0)
    path = reference(Trial("circle", 2.0, 0.0))
    record = run_trial(database, index_of(database), path, options)

    explanation = explain_choice(database, index_of(database), path, options, record, 299)

    assert explanation.reason == "clip_ended"
    assert explanation.going_on is None
    assert explanation.chosen + 1 == record.rows[300]
    assert "ended" in explanation.sentence


def test_the_sentence_has_the_numbers_that_decided() -> None:
    made = played(continuing_bias=-0.25, switch_margin=0.01)
    record = made[1]
    tick = int(np.flatnonzero(record.status == Status.REPLACING)[0]) - 1

    sentence = explained(made, tick).sentence

    assert f"{record.match_cost[tick]:.4g}" in sentence
    assert f"{record.continuing_cost[tick]:.4g}" in sentence
    assert "-0.25 of bias" in sentence
    assert "margin of 0.01" in sentence


def test_rows_one_asks_about_are_listed_with_why_they_could_not_be_chosen() -> None:
    made = played(reselect_window_s=1 / 3)
    tick = 60
    row = int(made[1].rows[tick])
    last = int(DATABASE.starts[1]) - 1

    asked = explained(made, tick, others=(row + 3, last, row + 40)).others

    assert [candidate.row for candidate in asked] == [row + 3, last, row + 40]
    assert [candidate.barred for candidate in asked] == ["too near", "not selectable", None]


def test_ticks_and_rows_that_there_are_not_are_refused() -> None:
    made = played()

    with pytest.raises(MotionError, match="the trial has no tick 780; it has 780 ticks"):
        explained(made, 780)
    with pytest.raises(MotionError, match="row -1"):
        explained(made, 0, others=(-1,))


def test_a_record_of_another_database_is_refused() -> None:
    options, record = played()
    smaller = synthetic_database(random_tracks(1, seed=1))
    far = replace(record, rows=record.rows + 10_000)

    with pytest.raises(MotionError, match="another database"):
        explain_choice(smaller, index_of(smaller), PATH, options, far, 0)
