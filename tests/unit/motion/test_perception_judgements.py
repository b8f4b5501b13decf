"""Difference tables of judgements, the order of motions, and weights fitted to tables."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls  # pyrefly: ignore[implicit-reexport]  # scipy collects its names when it runs
from scipy.stats import spearmanr
from tests.support.tiers import is_soak

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.perception.fitting import (
    PairDifferences,
    bootstrap_weights,
    fit_component,
    fit_power,
    fit_quality,
    fit_shares,
    leave_one_motion_out,
    predict,
)
from marey_motion.perception.judging import (
    DifferenceTable,
    Judgements,
    difference_table,
    draw_trials,
    pair_counts_by_participant,
    simulate_judgements,
    triangle_violations,
)
from marey_motion.perception.metric import Component
from marey_motion.perception.ordering import order_motions
from marey_motion.perception.study_analysis import analyse_study
from marey_schemas.documents.metrics import classes_of

MOTIONS = 21
PAIRS = np.triu_indices(MOTIONS, 1)
TRUE = Component("positions", "manhattan", 0.07, 9.9, {"head": 0.02, "upper_arm": 0.36, "forearm": 0.43, "toe": 0.19})


def grouped() -> Floats:
    """Return differences of two groups of 14 and 7 motions, whose centres are 6 standard deviations apart."""
    points = np.random.default_rng(5).normal(size=(MOTIONS, 2))
    points[14:, 0] += 6.0
    table = np.linalg.norm(points[:, None] - points, axis=-1)
    return np.asarray(np.where(table > 0, 0.3 + 0.6 * table / table.max(), 0.0))


def pair_differences(seed: int = 2) -> PairDifferences:
    rng = np.random.default_rng(seed)
    frames = tuple(rng.gamma(2.0, 0.04, (rng.integers(30, 50), 8)) * rng.uniform(0.3, 2.0, 8) for _ in PAIRS[0])
    return PairDifferences("positions", classes_of("positions"), np.stack(PAIRS, axis=1).astype(np.int64), frames)


def test_trials_are_balanced_and_repeat_with_their_seed() -> None:
    drawn = draw_trials(MOTIONS, 29, seed=4)
    assert drawn.shape == (29, 63, 4)
    assert (np.diff(np.sort(drawn, axis=-1)) > 0).all()
    assert all((np.bincount(one.ravel(), minlength=MOTIONS) == 12).all() for one in drawn)
    np.testing.assert_array_equal(drawn, draw_trials(MOTIONS, 29, seed=4))
    shown = difference_table(
        Judgements(MOTIONS, np.zeros(1827, np.int64), drawn.reshape(-1, 4), np.zeros(1827, np.int64))
    ).shown
    assert shown[PAIRS].mean() == pytest.approx(52.2, abs=0.01)
    assert shown[PAIRS].std() < 4.0
    appearances = np.bincount(draw_trials(10, 1, seed=1, trials=6).ravel(), minlength=10)
    assert np.ptp(appearances) <= 1
    with pytest.raises(MotionError):
        draw_trials(3, 1, seed=0)


def test_one_pair_in_six_is_chosen_and_missing_pairs_are_missing() -> None:
    judgements = simulate_judgements(grouped(), 5, seed=8, noise=0.1)
    table = difference_table(judgements)
    assert table.chosen.sum() * 6 == table.shown.sum()
    seen = table.shown[PAIRS] > 0
    mean = np.average(table.differences[PAIRS][seen], weights=table.shown[PAIRS][seen])
    assert mean == pytest.approx(5 / 6, abs=1e-14)
    one = Judgements(5, np.zeros(1, np.int64), np.array([[3, 0, 1, 4]]), np.array([4]))  # places 1 and 3: motions 0, 4
    single = difference_table(one).differences
    assert single[0, 4] == single[4, 0] == 0.0
    assert single[0, 3] == 1.0
    assert np.isnan(single[2, :2]).all()
    assert (np.diag(single) == 0).all()
    by_person = pair_counts_by_participant(judgements)
    np.testing.assert_array_equal(by_person[0].sum(axis=0), table.shown[PAIRS])
    np.testing.assert_array_equal(by_person[1].sum(axis=0), table.chosen[PAIRS])
    for shown, chosen in (([[0, 1, 2, 2]], [0]), ([[0, 1, 2, 5]], [0]), ([[0, 1, 2, 3]], [6]), (np.empty((0, 4)), [])):
        with pytest.raises(MotionError):
            Judgements(5, np.zeros(len(chosen), np.int64), np.array(shown, np.int64), np.array(chosen, np.int64))


@pytest.mark.parametrize("participants", [1, 2, 3, 29])
def test_the_noise_is_the_error_of_the_differences_even_with_few_participants(participants: int) -> None:
    rng = np.random.default_rng(participants)

    def answered(trials: int) -> DifferenceTable:
        shown = rng.permuted(np.tile(np.arange(MOTIONS), (trials, 1)), axis=1)[:, :4]
        one, other = np.triu_indices(4, 1)
        utility = rng.gumbel(scale=0.1, size=(trials, 6)) - grouped()[shown[:, one], shown[:, other]]
        return difference_table(Judgements(MOTIONS, np.zeros(trials, np.int64), shown, np.argmax(utility, axis=1)))

    truth = answered(100_000).differences
    tables = [answered(63 * participants) for _ in range(20)]
    errors = [float(np.nanmean((table.differences - truth)[PAIRS] ** 2)) for table in tables]
    stated = [table.noise_ceiling or 0.0 for table in tables]
    assert np.sqrt(np.mean(np.square(stated))) == pytest.approx(np.sqrt(np.mean(errors)), rel=0.06)
    assert all(one == pytest.approx(np.sqrt(np.mean(errors)), rel=0.3) for one in stated)


def test_the_noise_is_unknown_without_repeated_answers() -> None:
    shown = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]])
    once = Judgements(MOTIONS, np.arange(3), shown, np.zeros(3, np.int64))
    assert difference_table(once).noise_ceiling is None
    again = Judgements(MOTIONS, np.arange(18) % 3, np.tile(shown, (6, 1)), np.arange(18) % 6)
    assert difference_table(again).noise_ceiling is not None


def test_triangle_inequalities_are_counted() -> None:
    assert triangle_violations(grouped()) == (0, 3990)
    table = np.array([[0.0, 0.1, 0.9], [0.1, 0.0, 0.2], [0.9, 0.2, 0.0]])
    assert triangle_violations(table) == (1, 3)
    table[0, 1] = table[1, 0] = np.nan
    assert triangle_violations(table) == (0, 0)


def test_simulated_participants_reveal_two_groups() -> None:
    truth = grouped()
    table = difference_table(simulate_judgements(truth, 29, seed=3, noise=0.05))
    assert spearmanr(table.differences[PAIRS], truth[PAIRS]).statistic >= 0.9
    violated, checked = triangle_violations(table.differences)
    assert violated / checked < 0.01
    assert table.noise_ceiling is not None
    assert 0.02 < table.noise_ceiling < 0.06
    order = order_motions(table.differences)
    small = order.groups == order.groups[-1]
    assert set(np.flatnonzero(small)) == set(range(14, 21))
    first = order.order[:14] if order.groups[0] == 0 else order.order[7:]
    assert set(first) == set(range(14))
    np.testing.assert_array_equal(order.membership > 0.5, order.groups == 1)
    holes = table.differences.copy()
    holes[0, 1] = holes[1, 0] = np.nan
    np.testing.assert_array_equal(order_motions(holes).groups, order.groups)
    holes[3] = np.nan
    with pytest.raises(MotionError):
        order_motions(holes)


def test_known_weights_are_recovered_from_a_table() -> None:
    pairs = pair_differences()
    perceived = predict(TRUE, pairs)
    fitted = fit_component(pairs, perceived, "manhattan")
    assert (fitted.constant, fitted.norm) == pytest.approx((TRUE.constant, TRUE.norm), rel=1e-11)
    found = [fitted.weights[name] - TRUE.weights.get(name, 0.0) for name in pairs.classes]
    assert np.abs(found).max() < 1e-12
    perceived[:40] = np.nan
    assert fit_quality(predict(fitted, pairs), perceived).rss < 1e-24
    assert fit_component(pairs, perceived, "manhattan").norm == pytest.approx(TRUE.norm, rel=1e-10)
    with pytest.raises(MotionError) as error:
        fit_component(pairs, np.full(len(perceived), np.nan), "manhattan")
    assert error.value.code == "too-few-pairs"
    with pytest.raises(MotionError) as error:
        fit_component(pairs, np.full(len(perceived), 0.5), "manhattan")
    assert error.value.code == "fit-without-weights"


STARTS = 1000 if is_soak() else 100


def fit_by_descent(means: Floats, perceived: Floats) -> Floats:
    """Return the sums of squares that projected gradient descent reaches from random starts: 1,000 (paper), or 100."""
    table = np.column_stack((np.ones(len(means)), means))
    scale = np.linalg.norm(table, axis=0)
    table = table / np.where(scale > 0, scale, 1.0)
    square, target = table.T @ table, table.T @ perceived
    step = 1.0 / np.linalg.eigvalsh(square)[-1]
    points = np.random.default_rng(0).uniform(0.0, 2.0 * np.linalg.norm(perceived), (STARTS, len(square)))
    ahead, speed = points, np.ones((STARTS, 1))
    for _ in range(20_000):
        new = np.maximum(ahead - step * (ahead @ square - target), 0.0)
        # A start that moves uphill loses its momentum.
        uphill = np.sum((ahead - new) * (new - points), axis=1, keepdims=True) > 0
        faster = np.where(uphill, 1.0, 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * speed**2)))
        moved = np.abs(new - points).max()
        ahead = new + np.where(uphill, 0.0, (speed - 1.0) / faster) * (new - points)
        points, speed = new, faster
        if moved < 1e-13:
            break
    return np.asarray(np.sum((points @ table.T - perceived) ** 2, axis=1))


def test_no_random_start_ends_below_the_least_squares() -> None:
    pairs = pair_differences()
    perceived = predict(TRUE, pairs) + np.random.default_rng(1).normal(0.0, 0.05, len(pairs.frames))
    fitted = predict(fit_component(pairs, perceived, "sigmoid"), pairs)
    best = np.sum((fitted - perceived) ** 2)
    reached = fit_by_descent(pairs.means("sigmoid"), perceived)
    assert reached.shape == (STARTS,)
    assert reached == pytest.approx(best, abs=1e-8)
    assert reached.min() > best - 1e-12


def test_the_exponent_is_found() -> None:
    pairs = pair_differences()
    truth = Component("positions", "power", 0.1, 1.4, {"forearm": 0.7, "calf": 0.3}, exponent=0.3)
    fitted = fit_power(pairs, predict(truth, pairs))
    assert fitted.exponent == pytest.approx(0.3, abs=1e-3)
    assert fit_quality(predict(fitted, pairs), predict(truth, pairs)).rmse < 1e-5


def test_uncertainty_comes_from_participants_and_validation_from_motions() -> None:
    pairs = pair_differences()
    truth = predict(TRUE, pairs)
    table = np.zeros((MOTIONS, MOTIONS))
    table[PAIRS] = truth / 3.0
    judgements = simulate_judgements(table + table.T, 12, seed=6, noise=0.05)
    perceived = difference_table(judgements).differences[PAIRS]
    draws = bootstrap_weights(pairs, *pair_counts_by_participant(judgements), "manhattan", draws=60)
    whole = fit_component(pairs, perceived, "manhattan")
    low, high = np.quantile(draws[:, 1:].sum(axis=1), (0.01, 0.99))
    assert low < whole.norm < high
    assert draws.std(axis=0).max() > 0
    noisy = truth + np.random.default_rng(1).normal(0.0, 0.2, len(truth))
    fitted = predict(fit_component(pairs, noisy, "manhattan"), pairs)
    left_out = leave_one_motion_out([pairs], noisy, "manhattan")
    assert fit_quality(left_out, noisy).rss > fit_quality(fitted, noisy).rss
    np.testing.assert_allclose(leave_one_motion_out([pairs], truth, "manhattan"), truth, atol=1e-9)


def test_the_error_for_new_motions_contains_no_share_fitted_to_them() -> None:
    judgements = simulate_judgements(grouped(), 4, seed=6, noise=0.1)
    perceived = difference_table(judgements).differences[PAIRS]
    parts = [pair_differences(1), replace(pair_differences(2), measurement="velocities")]
    means = [np.column_stack((np.ones(len(perceived)), part.means("manhattan"))) for part in parts]
    expected = np.zeros(len(perceived))
    for motion in range(MOTIONS):
        of_motion = (parts[0].pairs == motion).any(axis=1)
        rest = ~of_motion & np.isfinite(perceived)
        one, other = (each @ nnls(each[rest], perceived[rest])[0] for each in means)
        step = one - other
        share = np.clip(step[rest] @ (perceived - other)[rest] / (step[rest] @ step[rest]), 0.0, 1.0)
        expected[of_motion] += 0.5 * (other + share * step)[of_motion]
    (fit,) = [
        each
        for each in analyse_study(judgements, parts, name="t", draws=0, seed=0).fits
        if each.parts[0].component.shaping == "manhattan"
    ]
    assert fit.left_out_rmse == pytest.approx(fit_quality(expected, perceived).rmse, rel=1e-9)


def test_shares_are_the_optimum_on_the_simplex() -> None:
    rng = np.random.default_rng(0)
    components = [rng.random(50) for _ in range(3)]
    target = 0.7 * components[0] + 0.3 * components[2]
    assert fit_shares(components, target) == pytest.approx((0.7, 0.0, 0.3), abs=1e-12)
    target = rng.random(50)
    shares = fit_shares(components, target)
    loss = np.sum((np.column_stack(components) @ shares - target) ** 2)
    others: Ints | Floats = rng.dirichlet(np.ones(3), 4000)
    assert loss <= np.sum((others @ np.array(components) - target) ** 2, axis=1).min() + 1e-12
    assert sum(shares) == pytest.approx(1.0)


def test_qualities_are_those_of_their_formulas() -> None:
    quality = fit_quality(np.array([0.1, 0.4, 0.4, 9.0]), np.array([0.2, 0.3, 0.5, np.nan]))
    assert (quality.rss, quality.rmse_percent, quality.l2) == pytest.approx((0.03, 10.0, 0.06**0.5))
    assert quality.r2 == pytest.approx(1.0 - 0.03 / 0.046666667)
    assert np.isnan(fit_quality(np.ones(3), np.arange(3.0)).spearman)


@pytest.mark.parametrize("participants", [4, 5])
def test_intervals_of_weights_need_participants_who_can_be_drawn_in_many_ways(participants: int) -> None:
    judgements = simulate_judgements(grouped(), participants, seed=3, noise=0.05)
    fits = analyse_study(judgements, [pair_differences()], name="t", draws=10, seed=0).fits
    assert any(one.parts[0].intervals for one in fits) == (participants == 5)
