"""Optimisations lower their objective step by step, report each step, and can be continued from their report."""

import json
from itertools import pairwise
from typing import Any

import pytest
from tests.support.suggestion_cases import OPTIONS, UNWANTED, evaluated, named, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.objective import headline_means, objective_value
from marey_motion.evaluation.improvement.optimise import Optimisation, optimise
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.selection import without_sources
from marey_motion.evaluation.improvement.suggestion_documents import optimisation_to_tree
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.improvement import ObjectiveOptions, OptimisationOptions

TURNS = ("turn_left", "turn_right")
AIM = OptimisationOptions(objective=ObjectiveOptions(seconds=0.002), max_steps=6)


@pytest.fixture(scope="module")
def pool() -> MatchingDatabase:
    """A database of random clips, and of two turns that may be added."""
    turns = [arc_track(2.0, turn_rate, 6.0, uid=uid) for uid, turn_rate in zip(TURNS, (50.0, -50.0), strict=True)]
    return synthetic_database([*wandering_tracks(), *turns])


@pytest.fixture
def simulation(pool: MatchingDatabase) -> Resimulation:
    return Resimulation(pool, OPTIONS)


@pytest.fixture(scope="module")
def found(pool: MatchingDatabase) -> Optimisation:
    return optimise(Resimulation(pool, OPTIONS), AIM, absent=TURNS)


def test_the_objective_falls_with_every_step(found: Optimisation) -> None:
    values = [step.objective for step in found.steps]
    assert len(values) > 2
    assert all(before - after >= AIM.least_gain for before, after in pairwise(values))


def test_every_step_can_be_evaluated_again(pool: MatchingDatabase, found: Optimisation) -> None:
    for step in found.steps:
        again = evaluated(without_sources(pool, step.absent))
        seconds = sum(clip.frame_count for clip in again.clips) / 60
        assert step.metrics == headline_means(again.trials)
        assert step.data_s == seconds
        assert step.objective == objective_value(AIM.objective, again.trials, seconds)


def test_the_log_says_what_each_step_did(found: Optimisation) -> None:
    assert [step.number for step in found.steps] == list(range(len(found.steps)))
    assert (found.steps[0].action, found.steps[0].absent) == ("start", TURNS)
    for before, after in pairwise(found.steps):
        gone, came = set(after.absent) - set(before.absent), set(before.absent) - set(after.absent)
        assert (gone or came) == set(after.sources)
        assert after.action == ("remove" if gone else "add")
        assert after.evaluations > before.evaluations


def test_what_nothing_needs_goes_at_once_and_changes_no_trial(found: Optimisation) -> None:
    (step,) = (step for step in found.steps if set(UNWANTED) <= set(step.sources))
    assert step.changed_trials == 0


def test_no_candidate_would_have_been_better_at_any_step(pool: MatchingDatabase) -> None:
    simulation = Resimulation(pool, OPTIONS)
    aim = AIM.replace(consider=None, max_steps=2)
    found = optimise(simulation, aim, absent=TURNS)
    for before, after in pairwise(found.steps):
        absent = frozenset(before.absent)
        for source in simulation.sources:
            other = absent ^ {source}
            assert (
                objective_value(aim.objective, simulation.results(other), simulation.seconds(other)) >= after.objective
            )


def test_a_clip_that_helps_is_added_where_the_budget_of_data_allows(pool: MatchingDatabase) -> None:
    straight = synthetic_database(
        named([arc_track(1.0, 0.0, 6.0), arc_track(2.0, 0.0, 6.0), arc_track(2.0, 50.0, 6.0)])
    )
    aim = OptimisationOptions(objective=ObjectiveOptions(seconds=0.0))
    free = optimise(Resimulation(straight, OPTIONS), aim, absent=["clip_002"])
    assert ("add", ("clip_002",)) in [(step.action, step.sources) for step in free.steps]
    tight = optimise(Resimulation(straight, OPTIONS), aim.replace(max_data_s=15.0), absent=["clip_002"])
    assert all(step.action != "add" for step in tight.steps if step.data_s > 15.0)
    assert all(step.data_s <= 15.0 for step in tight.steps)


def test_it_ends_when_nothing_gains_or_the_budget_is_spent(simulation: Resimulation) -> None:
    greedy = optimise(simulation, AIM.replace(least_gain=1000.0))
    assert (greedy.ended, len(greedy.steps)) == ("no gain", 1)
    assert optimise(simulation, AIM.replace(max_steps=1)).ended == "steps"
    spent = optimise(simulation, AIM.replace(max_evaluations=3))
    assert spent.ended == "evaluations"
    assert spent.steps[-1].evaluations <= 3


def test_an_optimisation_goes_on_from_its_log_as_if_it_had_not_stopped(
    pool: MatchingDatabase, found: Optimisation
) -> None:
    resumed = optimise(Resimulation(pool, OPTIONS), AIM, absent=TURNS, log=found.steps[:2])
    assert resumed == found


def test_the_log_of_an_optimisation_is_a_plain_document(found: Optimisation) -> None:
    written = json.loads(json.dumps(optimisation_to_tree(found)))
    assert written["ended"] == found.ended
    assert [(step["objective"], step["sources"]) for step in written["steps"]] == [
        (step.objective, list(step.sources)) for step in found.steps
    ]


def test_each_step_is_handed_over_as_soon_as_it_is_made(simulation: Resimulation) -> None:
    made: list[Any] = []
    found = optimise(simulation, AIM.replace(max_steps=2), absent=TURNS, made=made.append)
    assert tuple(made) == found.steps


def test_a_log_of_something_else_is_refused(pool: MatchingDatabase, found: Optimisation) -> None:
    with pytest.raises(MotionError, match="step"):
        optimise(Resimulation(pool, OPTIONS.replace(duration_s=4.0)), AIM, log=found.steps)
    smaller = without_sources(pool, TURNS)
    with pytest.raises(MotionError, match="turn_left"):
        optimise(Resimulation(smaller, OPTIONS), AIM, log=found.steps[:1])


def test_the_work_can_be_stopped(pool: MatchingDatabase) -> None:
    with pytest.raises(EvaluationCancelled):
        optimise(Resimulation(pool, OPTIONS, cancelled=lambda: True), AIM)
