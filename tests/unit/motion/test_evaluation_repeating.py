"""Repeated measurements of an effect lie in its interval as often as the interval says."""

import numpy as np
import pytest
from scipy.stats import t as student
from tests.support.suggestion_cases import OPTIONS, wandering_tracks
from tests.support.synthetic_databases import synthetic_database

from marey_motion.arrays import Floats
from marey_motion.evaluation.compare import paired_change
from marey_motion.evaluation.improvement.effects import effect_of
from marey_motion.evaluation.improvement.objective import HEADLINES
from marey_motion.evaluation.improvement.repeating import RepeatedChange, repeated
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation
from marey_schemas.options.improvement import ObjectiveOptions

TRIALS, REPLICATES, MEASUREMENTS = 40, 8, 400


def measured(before: Floats, differences: Floats) -> RepeatedChange:
    """Return the effect of runs with these addends, (T, R) each."""
    total = before.sum(axis=0, keepdims=True)
    return repeated(
        paired_change("offset_mean", total, total + differences.sum(axis=0, keepdims=True)), before, differences
    )


def jumps(rng: np.random.Generator, affected: float, mean: float) -> tuple[Floats, Floats]:
    """Return runs of which some jump by the difference of two replicates, and on average by `mean` more.

    `affected` is the expected number of these runs; only a quarter of the trials can have them.
    """
    before = rng.normal(size=(TRIALS, REPLICATES)) / TRIALS
    jump = (mean + np.sqrt(2.0) * rng.normal(size=before.shape)) / TRIALS
    chance = np.where(np.arange(TRIALS) % 4, 0.0, 4.0 * affected / before.size)
    return before, np.where(rng.random(before.shape) < chance[:, None], jump, 0.0)


def coverages(affected: float, mean: float) -> tuple[float, float]:
    """Return the share of repetitions in the interval, and in that of Student's t, as wide as two measurements need."""
    rng = np.random.default_rng(int(10 * affected + mean))
    found = [measured(*jumps(rng, affected, mean)) for _ in range(MEASUREMENTS)]
    inside = plain = 0
    for one, again in zip(found, found[1:] + found[:1], strict=True):
        assert one.again_low is not None
        assert one.again_high is not None
        assert one.low is not None
        assert one.high is not None
        inside += one.again_low <= again.change <= one.again_high
        plain += abs(again.change - one.change) <= np.sqrt(0.5) * (one.high - one.low)
    return inside / len(found), plain / len(found)


@pytest.mark.parametrize("mean", [0.0, 2.0])
@pytest.mark.parametrize("affected", [0.5, 2.0, 8.0, 60.0])
def test_repetitions_lie_in_the_interval_even_if_few_runs_change(affected: float, mean: float) -> None:
    inside, plain = coverages(affected, mean)
    assert inside >= 0.9
    if affected <= 2.0:
        assert plain < 0.85, "the replicates alone do not show how large a jump is that did not happen"


@pytest.mark.parametrize("affected", [0.5, 4.0, 8.0, 20.0])
def test_the_stated_percentage_holds_even_if_a_jump_is_far_larger_than_chance(affected: float) -> None:
    """The measurements that found fewer than eight changed runs are counted apart from the others."""
    rng = np.random.default_rng(int(10 * affected))
    found = [measured(*jumps(rng, affected, 30.0)) for _ in range(MEASUREMENTS)]
    inside: dict[int, list[bool]] = {}
    for one, again in zip(found, found[1:] + found[:1], strict=True):
        assert one.again_low is not None
        assert one.again_high is not None
        assert one.again_percent is not None
        inside.setdefault(one.again_percent, []).append(one.again_low <= again.change <= one.again_high)
    assert set(inside) == {0.5: {75}, 4.0: {75, 95}, 8.0: {75, 95}, 20.0: {95}}[affected]
    for percent, cases in inside.items():
        assert np.mean(cases) >= percent / 100 - 0.02


def test_if_all_runs_change_the_interval_is_hardly_wider_than_that_of_normal_differences() -> None:
    rng = np.random.default_rng(3)
    before, after = rng.normal(size=(2, TRIALS, REPLICATES)) / TRIALS
    found = measured(before, after - before)
    assert found.again_low is not None
    exact = student.ppf(0.975, REPLICATES - 1) * np.sqrt(2.0 * 2.0 / TRIALS / REPLICATES)
    assert found.change - found.again_low == pytest.approx(exact, rel=0.05)


def test_if_each_run_changes_one_trial_has_the_textbook_interval_of_a_repetition() -> None:
    differences = np.array([[0.1, 0.3, 0.2, 0.6]])
    found = measured(np.array([[1.0, 3.0, 2.0, 9.0]]), differences)
    assert found.change == pytest.approx(0.3)
    half = student.ppf(0.975, 3) * differences.std(ddof=1) * np.sqrt(1 / 4 + 1 / 4)
    assert (found.again_low, found.again_high) == pytest.approx((0.3 - half, 0.3 + half))
    few = measured(np.ones((1, 2)), np.array([[0.1, 0.3]]))
    assert (few.again_low, few.again_high) == (None, None)


def test_an_effect_has_the_interval_of_its_single_runs_in_each_metric() -> None:
    pool = synthetic_database(wandering_tracks(4))
    simulation = Resimulation(pool, OPTIONS, replicates=range(3, 7))
    gone = frozenset(["clip_001"])
    weights = ObjectiveOptions(offset=2.0, abs_se_v=0.0, abs_se_omega_deg=0.0, pose_cost=0.0)
    effect = effect_of(simulation, weights, NONE, gone)
    sides = [simulation.by_replicate(absent) for absent in (NONE, gone)]
    for name in HEADLINES:
        variance = spread = 0.0
        jumps_m: list[float] = []
        count = len(simulation.trials)
        for trial in range(count):
            old, new = ([one[trial].metrics[name] or 0.0 for one in side] for side in sides)
            variance += np.var(np.subtract(new, old), ddof=1) / count**2
            spread += np.var(old, ddof=1) / count**3
            jumps_m += [(after - before) / count for before, after in zip(old, new, strict=True) if after != before]
        assert 0 < len(jumps_m) < 4 * count
        one_more = max(float(np.mean(np.square(jumps_m))), 2.0 * spread) * (1 - len(jumps_m) / 4 / count)
        half = student.ppf(0.975, 3) * np.sqrt(2.0 * (variance + one_more / 4) / 4)
        change = effect.headlines[name]
        assert isinstance(change, RepeatedChange)
        assert (change.again_low, change.again_high) == pytest.approx((change.change - half, change.change + half))
    offset, objective = effect.headlines["offset_mean"], effect.objective
    assert isinstance(offset, RepeatedChange)
    assert isinstance(objective, RepeatedChange)
    assert objective.again_high == pytest.approx(2.0 * (offset.again_high or 0.0))
