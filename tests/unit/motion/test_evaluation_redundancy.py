"""Predicted effect of leaving out clips: it equals an evaluation of the remaining clips."""

from collections.abc import Sequence
from typing import Literal

import pytest
from pydantic import ValidationError
from tests.support.suggestion_cases import OPTIONS, evaluated, named, wandering_tracks, with_mirrored
from tests.support.synthetic_databases import synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement import redundancy
from marey_motion.evaluation.improvement.objective import HEADLINES, headline_means, objective_value
from marey_motion.evaluation.improvement.redundancy import PlannedRemoval, leave_one_out, plan_removals
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.selection import without_sources
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.improvement import ObjectiveOptions


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return synthetic_database(wandering_tracks())


@pytest.fixture(scope="module")
def result(database: MatchingDatabase) -> EvaluationResult:
    return evaluated(database)


@pytest.fixture
def simulation(database: MatchingDatabase, result: EvaluationResult) -> Resimulation:
    return Resimulation(database, OPTIONS, records=result.records)


def test_trials_without_some_clips_are_those_of_a_database_made_without_them(
    database: MatchingDatabase, simulation: Resimulation
) -> None:
    for removed in (["clip_001"], ["clip_000", "clip_004"], ["fast_000"], ["clip_002", "clip_003", "clip_005"]):
        again = evaluated(without_sources(database, removed))
        assert simulation.results(removed) == again.trials


def test_the_order_in_which_parts_are_asked_for_does_not_matter(
    database: MatchingDatabase, result: EvaluationResult
) -> None:
    parts = [["clip_001"], ["clip_001", "clip_004"], [], ["clip_004"], ["clip_000", "clip_001", "clip_004"]]
    forwards, backwards = (Resimulation(database, OPTIONS) for _ in range(2))
    found = {tuple(part): forwards.results(part) for part in parts}
    assert found == {tuple(part): backwards.results(part) for part in reversed(parts)}
    assert found[()] == result.trials


def test_trials_that_do_not_need_a_clip_are_not_run_again(database: MatchingDatabase, simulation: Resimulation) -> None:
    needing = [outcome for outcome in simulation.outcomes() if "clip_001" in outcome.needed]
    assert 0 < len(needing) < len(simulation.trials)
    simulation.outcomes(["clip_001"])
    assert simulation.simulated == len(needing)
    simulation.outcomes(["clip_001", "fast_000"])
    assert simulation.simulated == len(needing)


def test_every_removal_is_told_with_the_change_that_an_evaluation_finds(
    database: MatchingDatabase, result: EvaluationResult, simulation: Resimulation
) -> None:
    objective = ObjectiveOptions()
    removals = leave_one_out(simulation, objective)
    assert {removal.source for removal in removals} == simulation.needed()
    before = headline_means(result.trials)
    for removal in removals:
        again = evaluated(without_sources(database, [removal.source]))
        after = headline_means(again.trials)
        changes = {name: change.change for name, change in removal.estimate.headlines.items()}
        assert changes == {name: after[name] - before[name] for name in HEADLINES}
        assert removal.harm == objective_value(objective, again.trials, 0.0) - objective_value(
            objective, result.trials, 0.0
        )
    assert [removal.harm_per_s for removal in removals] == sorted(removal.harm_per_s for removal in removals)


def planned(simulation: Resimulation, count: int, removed: Sequence[str] = ()) -> tuple[PlannedRemoval, ...]:
    """Plan removals by the default objective."""
    ranked = leave_one_out(simulation, ObjectiveOptions(), removed=removed)
    return plan_removals(simulation, ranked, count, ObjectiveOptions(), removed=removed)


def test_a_plan_predicts_every_step_exactly(database: MatchingDatabase, simulation: Resimulation) -> None:
    gone = ["fast_000", "fast_001"]
    plan = planned(simulation, 4, gone)
    for step in plan:
        gone.append(step.removal.source)
        again = evaluated(without_sources(database, gone))
        assert step.metrics == headline_means(again.trials)
        assert step.seconds_left == sum(clip.frame_count for clip in again.clips) / 60
    assert len(plan) == len(set(gone)) - 2 == 4


def test_a_plan_takes_the_least_harmful_removal_at_each_step(simulation: Resimulation) -> None:
    plan = planned(simulation, 3)
    gone: list[str] = []
    for step in plan:
        assert step.removal == leave_one_out(simulation, ObjectiveOptions(), removed=gone)[0]
        gone.append(step.removal.source)


def test_later_steps_of_a_plan_try_only_the_clips_that_came_first(
    database: MatchingDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(redundancy, "TRIED_AGAIN", 2)
    simulation = Resimulation(database, OPTIONS, headlines_only=True)
    ranked = leave_one_out(simulation, ObjectiveOptions())
    before = simulation.simulated
    plan = plan_removals(simulation, ranked, 3, ObjectiveOptions())
    few = simulation.simulated - before
    assert len(plan) == 3
    assert plan[0].removal == ranked[0]
    assert plan[1].removal.source in {removal.source for removal in ranked[1:3]}
    monkeypatch.setattr(redundancy, "TRIED_AGAIN", 99)
    every = Resimulation(database, OPTIONS, headlines_only=True)
    leave_one_out(every, ObjectiveOptions())
    plan_removals(every, ranked, 3, ObjectiveOptions())
    assert few < every.simulated - before


@pytest.mark.parametrize("window", ["circle", "all"])
def test_headline_metrics_alone_are_those_of_an_evaluation(
    database: MatchingDatabase, window: Literal["circle", "all"]
) -> None:
    options = OPTIONS.replace(families=("circle", "switching"), switch_every_s=2.0, window=window)
    whole, few = (Resimulation(database, options, replicates=(0, 3), headlines_only=only) for only in (False, True))
    for outcome, quick in zip(whole.outcomes(), few.outcomes(), strict=True):
        assert quick.result.metrics == {name: outcome.result.metrics[name] for name in HEADLINES}
        assert (quick.result.trial, quick.needed) == (outcome.result.trial, outcome.needed)


def test_only_as_many_clips_are_tried_as_asked_for_those_first_that_few_trials_need(simulation: Resimulation) -> None:
    few = leave_one_out(simulation, ObjectiveOptions(), consider=2)
    everything = leave_one_out(simulation, ObjectiveOptions())
    assert len(few) == 2
    assert max(removal.trials for removal in few) <= sorted(removal.trials for removal in everything)[1]


def test_a_clip_and_its_mirrored_twin_go_together() -> None:
    database = with_mirrored(wandering_tracks(3))
    simulation = Resimulation(database, OPTIONS)
    again = evaluated(without_sources(database, ["clip_001"]))
    assert simulation.results(["clip_001"]) == again.trials
    assert simulation.seconds() == sum(clip.frame_count for clip in database.clips) / 60 / 2


def test_the_last_clip_is_never_taken() -> None:
    simulation = Resimulation(synthetic_database(named(wandering_tracks(2)[:2])), OPTIONS)
    assert len(planned(simulation, 5)) <= 1


def test_a_clip_that_is_not_there_cannot_be_left_out(simulation: Resimulation) -> None:
    with pytest.raises(MotionError, match="no clip nobody"):
        simulation.results(["nobody"])


def test_the_work_can_be_stopped(database: MatchingDatabase) -> None:
    stopped = Resimulation(database, OPTIONS, cancelled=lambda: True)
    with pytest.raises(EvaluationCancelled):
        leave_one_out(stopped, ObjectiveOptions())


def test_progress_is_told_clip_by_clip(simulation: Resimulation) -> None:
    told = []
    leave_one_out(simulation, ObjectiveOptions(), progress=lambda *step: told.append(step))
    assert [step[0] for step in told] == list(range(1, len(told) + 1))
    assert {step[1] for step in told} == {len(told)}


def test_weights_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValidationError, match="pose_cost"):
        ObjectiveOptions(pose_cost=-1.0)
