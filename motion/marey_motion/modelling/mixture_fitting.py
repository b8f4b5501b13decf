"""Choice of a mixture of normal distributions for latent vectors: number of distributions and kind of covariance."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Literal, NamedTuple, get_args

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import ModelError
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.mixture_components import fit_components, parameter_count
from marey_schemas.options.modelling import CovarianceKind, Criterion, MixtureOptions

Refusal = Literal["", "small-component", "held-out"]

LEAST_EXAMPLES_PER_COMPONENT = 5
PATIENCE = 2
"""Number of successive component counts without improvement after which no larger count is tried."""
LOW_SHARE = 0.05
"""Share of a mixture's samples whose density is below the threshold for improbable examples."""
THRESHOLD_SAMPLES = 2000
WIDENINGS = tuple(float(2.0 ** (step / 8)) for step in range(17))
"""Factors of the covariances, from 1 to 4.

The least factor is chosen with which at most about 5 % of the left-out examples are below the threshold for improbable
examples.
"""


@dataclass(frozen=True)
class MixtureCandidate:
    """A mixture of a given number of components and kind of covariance, with its criteria.

    Parameters
    ----------
    components : int    number of components
    covariance : str    kind of covariance: "full", "tied" or "diagonal"
    bic, aic : float    Bayesian and Akaike information criterion
    log_likelihood : float    natural logarithm of the likelihood of all examples
    held_out_log_likelihood : float or None    mean log-likelihood of examples under mixtures that were fitted without
        their takes; None without cross-validation, or if a fold leaves fewer examples than components
    smallest_weight : float    the least weight of a component
    converged : bool    whether the fit converged
    refusal : str    reason why the mixture is excluded, regardless of its criteria; empty if it is not excluded.
        "small-component": a component has too few examples; "held-out": held-out examples are not more likely than
        with one component
    """

    components: int
    covariance: CovarianceKind
    bic: float
    aic: float
    log_likelihood: float
    held_out_log_likelihood: float | None
    smallest_weight: float
    converged: bool
    refusal: Refusal = ""


class HeldOut(NamedTuple):
    """Likelihoods of n examples under mixtures that were fitted without their takes, or without their performers.

    Parameters
    ----------
    log_likelihoods : (n,) float64    natural logarithms of densities
    thresholds : (n,) float64    log density that 5 % of the samples of the same mixture do not reach
    """

    log_likelihoods: Floats
    thresholds: Floats

    @property
    def low_share(self) -> float:
        """Share of the examples that are below the threshold; near 5 % if the likelihoods are calibrated."""
        return float((self.log_likelihoods < self.thresholds).mean())


@dataclass(frozen=True, eq=False)
class FittedMixture:
    """A mixture, the kind of its covariance, and the candidates compared.

    Parameters
    ----------
    mixture : LatentMixture    the mixture
    covariance : str    kind of covariance: "full", "tied", "diagonal", or "point" for examples that do not vary
    widening : float    factor of the covariances for likelihoods, at least 1. It applies to `held_out` and
        `held_out_subjects`, not to the candidates. If the options do not set the factor, it is the least of `WIDENINGS`
        with which at most 5 % of the left-out examples (rounded up) are below their thresholds (see `HeldOut`). It is
        the greatest of `WIDENINGS` if no factor is sufficient, and 1 if `held_out` is None
    candidates : tuple of MixtureCandidate    sorted by kind of covariance, then by number of components; empty for
        examples that do not vary
    held_out, held_out_subjects : HeldOut, optional    likelihoods of examples whose take, or whose performer, was left
        out; None if there are too few of them
    """

    mixture: LatentMixture
    covariance: CovarianceKind | Literal["point"]
    widening: float
    candidates: tuple[MixtureCandidate, ...]
    held_out: HeldOut | None
    held_out_subjects: HeldOut | None


@contextmanager
def one_thread() -> Iterator[None]:
    """Run linear algebra and clustering on one thread, because the rounding of sums depends on the number of threads.

    Yields
    ------
    None    once, within the context
    """
    from threadpoolctl import threadpool_limits

    for module in ("scipy.linalg", "sklearn.mixture"):
        import_module(module)  # libraries that are loaded later would not be held to it
    with threadpool_limits(1):
        yield


def fit_mixture(
    latents: Floats, options: MixtureOptions | None = None, *, groups: ExampleGroups | None = None, seed: int = 0
) -> FittedMixture:
    """Fit a mixture to latent vectors.

    Mixtures with the kinds of covariance and the numbers of components that `options` allow are compared by
    `options.criterion`. If the criterion is "held_out", the mixture with the fewest parameters is chosen among the
    mixtures whose held-out likelihood is at most one standard error lower than that of the best mixture. Without
    cross-validation, "bic" replaces "held_out".

    Unless the options set the number of components, a mixture of several components is excluded if the weight of a
    component corresponds to fewer than 5 examples. With "bic" and "aic", it is also excluded if it makes left-out
    examples no more likely than one component does.

    Parameters
    ----------
    latents : (n, d) float64    latent vectors
    options : MixtureOptions, optional    numbers and kinds of distributions to try, and the criterion of the choice
    groups : ExampleGroups, optional    takes and performers; by default, each example is a take of its own
    seed : int    the same seed gives the same mixture

    Returns
    -------
    FittedMixture    mixture and candidates

    Raises
    ------
    ModelError    if a latent vector is not finite, or if all latent vectors are equal; vectors without dimensions are
        accepted
    """
    examples, dimensions = latents.shape
    wanted = options or MixtureOptions()
    if not np.isfinite(latents).all():
        raise ModelError("latent vectors must be finite numbers", where="latents")
    if dimensions == 0:
        point = LatentMixture(np.ones(1), latents.mean(axis=0)[None], np.zeros((1, 0, 0)))
        return FittedMixture(point, "point", 1.0, (), None, None)
    # In units of the mean deviation, everything below is independent of the scale of the data.
    unit = float(np.sqrt(latents.var(axis=0).mean()))
    if not unit > 0.0:
        raise ModelError("all latent vectors are equal, so no mixture can be fitted to them", where="latents")
    with one_thread():
        found = _Fitting(latents / unit, wanted, groups or ExampleGroups.alone(examples), seed).choose()
    shift = dimensions * float(np.log(unit))
    mixture = found.mixture
    return replace(
        found,
        mixture=LatentMixture(mixture.weights, mixture.means * unit, mixture.covariances * unit**2),
        candidates=tuple(_rescaled(candidate, shift, examples) for candidate in found.candidates),
        held_out=_shifted(found.held_out, shift),
        held_out_subjects=_shifted(found.held_out_subjects, shift),
    )


class _Tried(NamedTuple):
    """A candidate with its mixture, and the log-likelihoods of left-out examples; None without cross-validation."""

    candidate: MixtureCandidate
    mixture: LatentMixture
    held_out: Floats | None


@dataclass(frozen=True, eq=False)
class _Unseen:
    """Latent vectors (n, d), the number (n,) of each vector's fold, and for each fold, a mixture fitted without it."""

    latents: Floats
    folds: Ints
    mixtures: tuple[LatentMixture, ...]
    seed: int

    def judged(self, widening: float = 1.0) -> HeldOut:
        """Compute the likelihood and the threshold of each example under the mixture fitted without the example's fold.

        The covariances of each mixture are first multiplied by `widening`.
        """
        found = HeldOut(np.empty(len(self.folds)), np.empty(len(self.folds)))
        for fold, fitted in enumerate(self.mixtures):
            mixture = fitted.widened(widening)
            found.log_likelihoods[self.folds == fold] = mixture.log_density(self.latents[self.folds == fold])
            found.thresholds[self.folds == fold] = low_density(mixture, self.seed)
        return found

    def calibration(self) -> float:
        """Find the least widening with which at most 5 % of the examples (rounded up) are below the threshold.

        Returns the greatest widening if none is sufficient.
        """
        allowed = np.ceil(LOW_SHARE * len(self.folds)) / len(self.folds)
        fits = (factor for factor in WIDENINGS if self.judged(factor).low_share <= allowed)
        return next(fits, WIDENINGS[-1])


@dataclass(frozen=True, eq=False)
class _Fitting:
    """Fit of a mixture to latent vectors of unit mean variance."""

    latents: Floats
    options: MixtureOptions
    groups: ExampleGroups
    seed: int

    def choose(self) -> FittedMixture:
        """Choose the mixture, and compute the likelihoods of left-out examples for it."""
        folds = self.groups.take_folds(self.options.folds, self.seed)
        criterion: Criterion = (
            "bic" if folds is None and self.options.criterion == "held_out" else self.options.criterion
        )
        kinds = get_args(CovarianceKind) if self.options.covariance is None else (self.options.covariance,)
        tried = [one for kind in kinds for one in self._of_kind(kind, criterion, folds)]
        if criterion == "held_out" and all(one.held_out is None for one in tried):
            criterion = "bic"
        judged = tried if criterion == "held_out" else _with_refusals(tried)
        fixed = self.options.mixture_components is not None
        usable = [one for one in judged if fixed or not one.candidate.refusal]
        if criterion == "held_out":
            usable = [one for one in usable if one.held_out is not None]
        best = max(usable, key=lambda one: _score(one.candidate, criterion))
        if criterion == "held_out":
            best = self._simplest(usable, best)
        count, kind = best.candidate.components, best.candidate.covariance
        unseen = self._unseen(count, kind, folds)
        widening = self.options.widening or (1.0 if unseen is None else unseen.calibration())
        by_subject = self._unseen(count, kind, self.groups.subject_folds() if self.options.folds else None)
        return FittedMixture(
            mixture=best.mixture,
            covariance=kind,
            widening=widening,
            candidates=tuple(one.candidate for one in judged),
            held_out=None if unseen is None else unseen.judged(widening),
            held_out_subjects=None if by_subject is None else by_subject.judged(widening),
        )

    def _of_kind(self, kind: CovarianceKind, criterion: Criterion, folds: Ints | None) -> Iterator[_Tried]:
        """Yield mixtures with one kind of covariance and 1, 2, ... components, until more components do not help.

        If the options set the number of components, only the mixture with this number is yielded.
        """
        fixed = self.options.mixture_components
        most = max(1, min(self.options.most_mixture_components, len(self.latents) // LEAST_EXAMPLES_PER_COMPONENT))
        best, worse = -np.inf, 0
        for count in range(1, most + 1) if fixed is None else (fixed,):
            if count == 1 and kind == "tied" and self.options.covariance is None:
                continue  # the same as full
            mixture, converged = self._fit(self.latents, count, kind, self.options.starts)
            unseen = self._unseen(count, kind, folds)
            held_out = None if unseen is None else unseen.judged().log_likelihoods
            candidate = self._judged(count, kind, mixture, converged, held_out)
            yield _Tried(candidate, mixture, held_out)
            score = _score(candidate, criterion)
            worse = 0 if score > best else worse + 1
            best = max(best, score)
            if worse == PATIENCE:
                return

    def _judged(
        self, count: int, kind: CovarianceKind, mixture: LatentMixture, converged: bool, held_out: Floats | None
    ) -> MixtureCandidate:
        examples, dimensions = self.latents.shape
        likelihood = float(mixture.log_density(self.latents).sum())
        numbers = parameter_count(count, dimensions, kind)
        smallest = float(mixture.weights.min())
        small = count > 1 and smallest * examples < LEAST_EXAMPLES_PER_COMPONENT
        return MixtureCandidate(
            components=count,
            covariance=kind,
            bic=numbers * float(np.log(examples)) - 2.0 * likelihood,
            aic=2.0 * numbers - 2.0 * likelihood,
            log_likelihood=likelihood,
            held_out_log_likelihood=None if held_out is None else float(held_out.mean()),
            smallest_weight=smallest,
            converged=converged,
            refusal="small-component" if small else "",
        )

    def _simplest(self, tried: list[_Tried], best: _Tried) -> _Tried:
        """Find the mixture with the fewest parameters among all that are as good for left-out examples as the best."""

        def size(one: _Tried) -> tuple[int, float]:
            candidate = one.candidate
            numbers = parameter_count(candidate.components, self.latents.shape[1], candidate.covariance)
            return numbers, -_score(candidate, "held_out")

        return min((one for one in tried if self._is_as_good(one, best)), key=size)

    def _is_as_good(self, one: _Tried, best: _Tried) -> bool:
        """Return whether a mixture is as good for left-out examples as the best one, within one standard error.

        Compares the mean log-likelihoods of left-out examples. Examples of one take are not independent, so the
        standard error is computed from sums over takes.
        """
        assert one.held_out is not None
        assert best.held_out is not None
        gained = best.held_out - one.held_out
        sums = np.bincount(self.groups.takes, weights=gained - gained.mean())
        return bool(gained.mean() <= np.sqrt((sums**2).sum()) / len(gained))

    def _unseen(self, count: int, kind: CovarianceKind, folds: Ints | None) -> _Unseen | None:
        """Fit a mixture without each fold; None without folds, or if a fold leaves fewer examples than components."""
        if folds is None or len(folds) - np.bincount(folds).max() < count:
            return None
        mixtures = [self._fit(self.latents[folds != fold], count, kind, 1)[0] for fold in range(int(folds.max()) + 1)]
        return _Unseen(self.latents, folds, tuple(mixtures), self.seed)

    def _fit(self, latents: Floats, count: int, kind: CovarianceKind, starts: int) -> tuple[LatentMixture, bool]:
        return fit_components(
            latents, count, kind, regularisation=self.options.regularisation, starts=starts, seed=self.seed
        )


def low_density(mixture: LatentMixture, seed: int) -> float:
    """Compute the log density that 5 % of the samples of a mixture do not reach.

    Parameters
    ----------
    mixture : LatentMixture    the mixture
    seed : int    seed of the samples

    Returns
    -------
    float    natural logarithm
    """
    return float(np.quantile(mixture.log_density(mixture.sample(THRESHOLD_SAMPLES, seed)), LOW_SHARE))


def _score(candidate: MixtureCandidate, criterion: Criterion) -> float:
    """Return the value of the criterion for a candidate, with the sign chosen so that higher is better."""
    if criterion == "held_out":
        return float("-inf") if candidate.held_out_log_likelihood is None else candidate.held_out_log_likelihood
    return -(candidate.bic if criterion == "bic" else candidate.aic)


def _with_refusals(tried: list[_Tried]) -> list[_Tried]:
    """Refuse mixtures of several components that make left-out examples no more likely than one component does."""
    singles = [_score(one.candidate, "held_out") for one in tried if one.candidate.components == 1]
    least = max(singles, default=-np.inf)
    return [
        one._replace(candidate=replace(one.candidate, refusal="held-out"))
        if one.held_out is not None
        and one.candidate.components > 1
        and not one.candidate.refusal
        and _score(one.candidate, "held_out") <= least
        else one
        for one in tried
    ]


def _shifted(held_out: HeldOut | None, shift: float) -> HeldOut | None:
    """Convert likelihoods to the units of the data; `shift` is the change of each log density by the scaling."""
    return None if held_out is None else HeldOut(held_out.log_likelihoods - shift, held_out.thresholds - shift)


def _rescaled(candidate: MixtureCandidate, shift: float, examples: int) -> MixtureCandidate:
    """Convert a candidate to the units of the data; `shift` is the change of each log density by the scaling."""
    held_out = candidate.held_out_log_likelihood
    return replace(
        candidate,
        bic=candidate.bic + 2.0 * shift * examples,
        aic=candidate.aic + 2.0 * shift * examples,
        log_likelihood=candidate.log_likelihood - shift * examples,
        held_out_log_likelihood=None if held_out is None else held_out - shift,
    )
