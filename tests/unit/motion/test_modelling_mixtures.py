"""Mixtures of normal distributions: their densities and samples, and the chosen number of components."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from tests.support.present import present
from tests.support.tiers import examples, is_soak

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.mixture_fitting import fit_mixture, one_thread
from marey_schemas.options.modelling import CovarianceKind, MixtureOptions

THOROUGH = MixtureOptions() if is_soak() else MixtureOptions(starts=2)
"""Options of fits for tests that do not depend on the number of starts."""


def two_kinds(examples: int = 200, dimensions: int = 3, apart: float = 8.0, seed: int = 0) -> Floats:
    """Return examples of two well separated kinds, in the ratio 3 to 2."""
    random = np.random.default_rng(seed)
    kinds = random.random(examples) < 0.6
    return random.standard_normal((examples, dimensions)) + apart * np.where(kinds, 0.5, -0.5)[:, None]


def some_mixture(components: int = 3, dimensions: int = 4, seed: int = 0) -> LatentMixture:
    random = np.random.default_rng(seed)
    spread = random.standard_normal((components, dimensions, dimensions))
    covariances = spread @ spread.transpose(0, 2, 1) + 0.1 * np.eye(dimensions)
    weights = random.uniform(0.2, 1.0, components)
    return LatentMixture(weights / weights.sum(), random.standard_normal((components, dimensions)), covariances)


@given(st.integers(0, 1000), st.integers(1, 5), st.integers(1, 6))
def test_densities_are_those_of_an_independent_library(seed: int, components: int, dimensions: int) -> None:
    mixture = some_mixture(components, dimensions, seed)
    points = np.random.default_rng(seed).standard_normal((7, dimensions))
    each = [
        np.log(weight) + np.atleast_1d(multivariate_normal(mean, covariance).logpdf(points))
        for weight, mean, covariance in zip(mixture.weights, mixture.means, mixture.covariances, strict=True)
    ]
    np.testing.assert_allclose(mixture.component_log_densities(points), np.stack(each, axis=1), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(mixture.log_density(points), logsumexp(each, axis=0), rtol=1e-8, atol=1e-8)


def test_samples_have_the_means_and_covariances_of_the_mixture() -> None:
    mixture = some_mixture(2, 3, 5)
    drawn = mixture.sample(200_000, 1)
    mean = mixture.weights @ mixture.means
    away = mixture.means - mean
    covariance = np.einsum("k,kij->ij", mixture.weights, mixture.covariances + away[:, :, None] * away[:, None, :])
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.05)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, rtol=0.05, atol=0.05)


@given(st.integers(0, 2**63 - 1), st.integers(1, 30), st.integers(1, 30))
def test_samples_are_the_same_for_the_same_seed_and_begin_alike(seed: int, few: int, many: int) -> None:
    mixture = some_mixture()
    shared = min(few, many)
    assert np.array_equal(mixture.sample(few, seed)[:shared], mixture.sample(many, seed)[:shared])
    assert not np.array_equal(mixture.sample(few, seed, 1), mixture.sample(few, seed))


def test_a_mixture_of_nothing_gives_samples_of_nothing() -> None:
    point = fit_mixture(np.empty((6, 0)))
    assert point.covariance == "point"
    assert point.mixture.sample(3, 0).shape == (3, 0)
    np.testing.assert_array_equal(point.mixture.log_density(np.empty((2, 0))), 0.0)


def test_what_is_no_mixture_is_refused() -> None:
    for weights, covariances in (((0.5, 0.6), np.eye(2)), ((1.0,), np.eye(2)), ((0.5, 0.5), np.eye(3))):
        with pytest.raises(MotionError):
            LatentMixture(np.array(weights), np.zeros((2, 2)), np.stack([covariances] * 2))
    flat = LatentMixture(np.ones(1), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    with pytest.raises(MotionError, match="positive definite"):
        flat.log_density(np.zeros((1, 2)))


# -- fitting -----------------------------------------------------------------------------------------------------------


def test_the_number_of_kinds_is_found() -> None:
    fitted = fit_mixture(two_kinds())
    assert len(fitted.mixture.weights) == 2
    assert fitted.mixture.weights[0] == pytest.approx(0.6, abs=0.08)
    best = min(fitted.candidates, key=lambda one: one.bic)
    assert best.components == 2


def three_kinds(seed: int) -> Floats:
    """Return 60 examples in 12 dimensions, 20 of each of three kinds."""
    random = np.random.default_rng(seed)
    return np.concatenate([mean + random.standard_normal((20, 12)) for mean in 2.5 * random.standard_normal((3, 12))])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
def test_three_kinds_in_twelve_dimensions_are_found_in_sixty_examples(seed: int) -> None:
    fitted = fit_mixture(three_kinds(seed), MixtureOptions(starts=2))
    assert fitted.mixture.weights == pytest.approx(np.full(3, 1 / 3), abs=0.01)
    nearest = fitted.mixture.component_log_densities(three_kinds(seed)).argmax(axis=1).reshape(3, 20)
    assert (nearest == nearest[:, :1]).all()
    assert {one.covariance for one in fitted.candidates} == {"full", "tied", "diagonal"}
    assert fitted.held_out is not None
    assert fitted.held_out.low_share <= 0.05


@pytest.mark.parametrize("kind", ["full", "tied", "diagonal"])
def test_components_are_tried_up_to_ten_or_until_more_do_not_help(kind: CovarianceKind) -> None:
    options = MixtureOptions(covariance=kind, starts=1)
    fitted = fit_mixture(three_kinds(0), options)
    assert [one.components for one in fitted.candidates] == [1, 2, 3, 4, 5]
    assert {one.covariance for one in fitted.candidates} == {kind}
    few = fit_mixture(np.random.default_rng(7).standard_normal((14, 4)), options)
    assert [one.components for one in few.candidates] == [1, 2]


def test_a_covariance_of_few_examples_is_shrunk_towards_its_diagonal() -> None:
    examples = np.random.default_rng(3).standard_normal((14, 12)) * np.linspace(3.0, 0.3, 12)
    fitted = fit_mixture(examples, MixtureOptions(covariance="full", mixture_components=1))
    covariance = fitted.mixture.covariances[0]
    sample = np.cov(examples.T, bias=True)
    np.testing.assert_allclose(np.diag(covariance), np.diag(sample), rtol=0.5)
    off = ~np.eye(12, dtype=bool)
    assert np.abs(covariance[off]).sum() < 0.6 * np.abs(sample[off]).sum()


def steps_of_takes(seed: int = 0) -> tuple[Floats, ExampleGroups]:
    """Return 60 examples in 15 takes of 3 performers; examples of a take, and takes of a performer, are alike."""
    random = np.random.default_rng(seed)
    takes = np.repeat(np.arange(15), 4)
    subjects = takes // 5
    places = 3.0 * random.standard_normal((3, 4))[subjects] + random.standard_normal((15, 4))[takes]
    return places + 0.1 * random.standard_normal((60, 4)), ExampleGroups(takes, subjects)


def test_what_is_held_out_is_never_seen_in_its_take_or_its_performer() -> None:
    """Examples of one take are nearly equal: an earlier program left out one of them and kept the others."""
    examples, groups = steps_of_takes()
    options = MixtureOptions(covariance="full", mixture_components=3, widening=1, starts=1)
    by_take = fit_mixture(examples, options, groups=groups)
    mixed = fit_mixture(examples, options)
    assert by_take.held_out is not None
    assert by_take.held_out_subjects is not None
    assert mixed.held_out is not None
    assert mixed.held_out_subjects is None
    means = [one.log_likelihoods.mean() for one in (mixed.held_out, by_take.held_out, by_take.held_out_subjects)]
    assert means[0] > means[1] > means[2]


def test_folds_divide_takes_and_not_examples() -> None:
    _, groups = steps_of_takes()
    folds = groups.take_folds(5, 0)
    assert folds is not None
    assert sorted(set(folds.tolist())) == [0, 1, 2, 3, 4]
    assert all(len(set(folds[groups.takes == take].tolist())) == 1 for take in range(15))
    assert np.array_equal(present(groups.subject_folds()), present(groups.subjects))
    assert ExampleGroups(np.zeros(9, dtype=np.int64), None).take_folds(5, 0) is None
    assert ExampleGroups.alone(9).subject_folds() is None


def test_likelihoods_are_calibrated_by_what_is_held_out() -> None:
    heavy = np.random.default_rng(5).standard_t(3, (120, 6))
    plain = fit_mixture(heavy, MixtureOptions(widening=1, mixture_components=1, covariance="full"))
    fitted = fit_mixture(heavy, MixtureOptions(mixture_components=1, covariance="full"))
    assert plain.held_out is not None
    assert fitted.held_out is not None
    assert plain.held_out.low_share > 0.08
    assert fitted.held_out.low_share <= 0.05
    assert fitted.widening > plain.widening == 1.0
    assert np.array_equal(fitted.mixture.covariances, plain.mixture.covariances)


def test_one_kind_in_many_dimensions_is_one_component() -> None:
    """The published method (Akaike's criterion, up to 40 components) finds 24 components in such data."""
    one_kind = np.random.default_rng(2).standard_normal((89, 12)) * np.linspace(3.0, 0.3, 12)
    assert len(fit_mixture(one_kind).mixture.weights) == 1


def test_identical_examples_give_identical_mixtures_every_time() -> None:
    """An earlier version had no seed, so the number of components differed from run to run."""
    random = np.random.default_rng(4)
    examples = np.concatenate([random.standard_normal((25, 2)) + 3.0 * random.standard_normal(2) for _ in range(4)])
    first, second = (fit_mixture(examples, THOROUGH, seed=3) for _ in range(2))
    assert np.array_equal(first.mixture.means, second.mixture.means)
    assert np.array_equal(first.mixture.covariances, second.mixture.covariances)
    assert first.candidates == second.candidates


@settings(max_examples=examples(2, soak=4))
@given(st.sampled_from([1e-4, 0.03, 7.0, 1e4]), st.integers(0, 50))
def test_the_choice_does_not_depend_on_the_unit(unit: float, seed: int) -> None:
    examples = two_kinds(80, 2, 5.0, seed)
    plain, scaled = fit_mixture(examples, THOROUGH), fit_mixture(examples * unit, THOROUGH)
    assert len(plain.mixture.weights) == len(scaled.mixture.weights)
    np.testing.assert_allclose(scaled.mixture.means, plain.mixture.means * unit, rtol=1e-6, atol=1e-6 * unit)
    shift = 2 * 80 * np.log(unit)
    for one, other in zip(plain.candidates, scaled.candidates, strict=True):
        assert other.log_likelihood == pytest.approx(one.log_likelihood - shift, abs=1e-4)
    densities = scaled.mixture.log_density(examples * unit)
    assert any(one.log_likelihood == pytest.approx(densities.sum()) for one in scaled.candidates)


def test_few_examples_get_one_shrunk_component() -> None:
    examples = np.random.default_rng(1).standard_normal((6, 8))
    fitted = fit_mixture(examples)
    assert len(fitted.mixture.weights) == 1
    assert np.linalg.eigvalsh(fitted.mixture.covariances[0])[0] > 1e-3
    np.testing.assert_allclose(fitted.mixture.means[0], examples.mean(axis=0))


def test_the_heaviest_component_comes_first() -> None:
    fitted = fit_mixture(two_kinds(seed=9), MixtureOptions(starts=1))
    assert len(fitted.mixture.weights) == 2
    assert (np.diff(fitted.mixture.weights) <= 0.0).all()
    assert fitted.mixture.means[0].mean() > 0.0


def test_a_component_of_a_few_stray_examples_is_not_taken() -> None:
    examples = two_kinds(60, 2, 0.0)
    examples[:2] += 60.0
    fitted = fit_mixture(examples, THOROUGH)
    assert {one.refusal for one in fitted.candidates if one.components > 1} >= {"small-component"}
    assert fitted.mixture.weights.min() * 60 >= 5 or len(fitted.mixture.weights) == 1


def test_a_mixture_that_fits_its_own_examples_alone_is_not_taken() -> None:
    random = np.random.default_rng(11)
    options = MixtureOptions(criterion="aic", covariance="full", starts=1)
    fits = [fit_mixture(random.standard_t(4, (26, 6)), options) for _ in range(8)]
    assert "held-out" in {one.refusal for fitted in fits for one in fitted.candidates}


def test_held_out_likelihoods_are_those_of_mixtures_that_lack_the_example() -> None:
    examples = two_kinds(100)
    fitted = fit_mixture(examples, THOROUGH)
    assert fitted.held_out is not None
    assert fitted.held_out.log_likelihoods.shape == (100,)
    assert fitted.held_out.log_likelihoods.mean() < fitted.mixture.log_density(examples).mean()
    stray = np.concatenate((examples, [[80.0, 0.0, 0.0]]))
    held_out = fit_mixture(stray, THOROUGH).held_out
    assert held_out is not None
    assert held_out.log_likelihoods.argmin() == 100
    assert fit_mixture(examples, THOROUGH.replace(folds=0)).held_out is None


def test_the_choice_can_be_made_by_hand() -> None:
    assert len(fit_mixture(two_kinds(), MixtureOptions(mixture_components=3)).mixture.weights) == 3
    with pytest.raises(MotionError, match="9 components needs at least 9 examples; there are 8"):
        fit_mixture(two_kinds(8), MixtureOptions(mixture_components=9))


def test_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(MotionError, match="finite"):
        fit_mixture(np.full((5, 2), np.nan))
    with pytest.raises(MotionError, match="all latent vectors are equal"):
        fit_mixture(np.ones((5, 2)))


def test_libraries_keep_to_one_thread() -> None:
    from threadpoolctl import threadpool_info

    with one_thread():
        assert {library["num_threads"] for library in threadpool_info()} == {1}


@pytest.mark.parametrize(("takes", "components"), [((6, 6), 7), ((6, 1, 1, 1, 1), 5)])
def test_more_components_than_examples_without_a_take_are_judged_without_folds(
    takes: tuple[int, ...], components: int
) -> None:
    groups = ExampleGroups(np.repeat(np.arange(len(takes)), takes), None)
    fitted = fit_mixture(two_kinds(sum(takes)), MixtureOptions(mixture_components=components), groups=groups)
    assert len(fitted.mixture.weights) == components
    assert (fitted.held_out, fitted.widening) == (None, 1.0)
    assert all(candidate.held_out_log_likelihood is None for candidate in fitted.candidates)
