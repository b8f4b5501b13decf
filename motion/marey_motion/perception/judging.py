"""Judgements of the participants of a study, and the table of perceived differences computed from them.

In each trial, a participant sees four motions side by side, and chooses the two that look most similar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_schemas.documents.studies import SHOWN

TRIALS = 63
LEAST_REPEATS = 30
"""Least number of repeated answers from which the noise can be estimated to within a quarter.

An answer about a pair of motions is repeated if the pair was shown before.
"""
_CANDIDATE_DRAWS = 24
_FIRST, _SECOND = np.triu_indices(SHOWN, 1)
_PAIR_OF = {(int(one), int(other)): pair for pair, (one, other) in enumerate(zip(_FIRST, _SECOND, strict=True))}
"""Index of a pair of places on the screen, by the two places."""
Answer = tuple[int, Sequence[int], tuple[int, int]]
"""Answered trial: number of the participant, motions shown by place, and the two chosen places in ascending order."""


@dataclass(frozen=True, eq=False)
class Judgements:
    """T answered trials, without the trials that timed out.

    Parameters
    ----------
    motion_count : int    number of motions n
    participants : (T,) int64    participant of each trial, from 0
    shown : (T, 4) int64    the motions shown, by place on the screen; all different
    chosen : (T,) int64    the pair that was chosen as the most similar one, as an index into the pairs of places
        (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)
    """

    motion_count: int
    participants: Ints
    shown: Ints
    chosen: Ints

    def __post_init__(self) -> None:
        trials = len(self.shown)
        if self.shown.shape != (trials, SHOWN) or {self.participants.shape, self.chosen.shape} != {(trials,)}:
            raise MotionError("each trial needs a participant, four motions and a chosen pair")
        if not trials:
            raise MotionError("the judgements contain no answered trial; at least one is needed")
        ordered = np.sort(self.shown, axis=1)
        wrong = (ordered[:, 0] < 0) | (ordered[:, -1] >= self.motion_count) | (np.diff(ordered) == 0).any(axis=1)
        wrong |= (self.chosen < 0) | (self.chosen >= len(_FIRST)) | (self.participants < 0)
        if wrong.any():
            raise MotionError(
                f"the motions must be four different numbers from 0 to {self.motion_count - 1}, the chosen pair a "
                f"number from 0 to {len(_FIRST) - 1}, and the participant a number of at least 0",
                where=f"trial {int(np.argmax(wrong))}",
            )


@dataclass(frozen=True, eq=False)
class DifferenceTable:
    """Perceived differences between n motions.

    Parameters
    ----------
    differences : (n, n) float64    1 - chosen / shown; 0 on the diagonal, NaN for pairs that were never shown together
    shown, chosen : (n, n) int64    numbers of trials in which each pair was shown together, and chosen; symmetric
    """

    differences: Floats
    shown: Ints
    chosen: Ints

    @property
    def noise_ceiling(self) -> float | None:
        """Root mean square of the standard errors of the differences: the least error to expect of any fit.

        The variance of a single answer is that of repeated answers about the same pair. A pair that was shown once has
        the difference 0 or 1, which says nothing about its error, so the variance is estimated from all pairs together.
        None if there are fewer than `LEAST_REPEATS` repeated answers. Differences between people are not included.
        """
        shown = self.shown[np.triu_indices(len(self.shown), 1)]
        p = self.differences[np.triu_indices(len(self.shown), 1)][shown > 0]
        shown = shown[shown > 0]
        repeats = np.sum(shown - 1)
        if repeats < LEAST_REPEATS:
            return None
        return float(np.sqrt(np.sum(shown * p * (1.0 - p)) / repeats * np.mean(1.0 / shown)))


def judgements_of(motion_count: int, answers: Sequence[Answer]) -> Judgements:
    """Return answered trials as arrays.

    Parameters
    ----------
    motion_count : int    number of motions
    answers : sequence of Answer    at least one

    Returns
    -------
    Judgements    the trials in the same order

    Raises
    ------
    MotionError    if there are no answers, or if an answer names a place or a motion that does not exist
    """
    wrong = next((number for number, answer in enumerate(answers) if answer[2] not in _PAIR_OF), None)
    if wrong is not None:
        raise MotionError(
            f"the chosen places {answers[wrong][2]} must be two different numbers from 0 to {SHOWN - 1}, in ascending "
            "order",
            where=f"trial {wrong}",
        )
    who = np.array([answer[0] for answer in answers], np.int64)
    shown = np.array([answer[1] for answer in answers], np.int64).reshape(len(answers), -1)
    return Judgements(motion_count, who, shown, np.array([_PAIR_OF[answer[2]] for answer in answers], np.int64))


def draw_trials(
    motion_count: int, participants: int, seed: int, trials: int = TRIALS, *, earlier: Ints | None = None
) -> Ints:
    """Draw the motions of a study's trials so that all motions, and all pairs, are shown about equally often.

    The numbers of times that a participant sees each motion differ by at most one. For each participant, several draws
    are made, and the draw is kept after which the counts of all pairs, summed over the participants so far, differ
    least.

    Parameters
    ----------
    motion_count : int    number of motions, at least 4
    participants : int    number of participants
    seed : int    the same seed gives the same trials
    trials : int    trials per participant
    earlier : (M, trials, 4) int64, optional    trials already drawn for the first M participants of this study; the
        result contains the trials of the next participants, which are the same as if all were drawn together

    Returns
    -------
    (participants, trials, 4) int64    motions by place on the screen

    Raises
    ------
    MotionError    for fewer than four motions
    """
    if motion_count < SHOWN:
        raise MotionError(f"a trial shows {SHOWN} different motions; there are only {motion_count}")
    first = 0 if earlier is None else len(earlier)
    counts = np.zeros((motion_count, motion_count), np.int64)
    if earlier is not None:
        counts = _pair_counts(earlier.reshape(-1, SHOWN), motion_count)
    drawn = np.empty((participants, trials, SHOWN), np.int64)
    for participant in range(participants):
        rng = np.random.default_rng([seed, first + participant])
        draws = [_one_draw(motion_count, trials, rng) for _ in range(_CANDIDATE_DRAWS)]
        tables = [counts + _pair_counts(draw, motion_count) for draw in draws]
        best = int(np.argmin([np.sum(table**2) for table in tables]))
        drawn[participant], counts = draws[best], tables[best]
    return drawn


def simulate_judgements(differences: Floats, participants: int, seed: int, noise: float) -> Judgements:
    """Simulate participants who choose the pair with the smallest difference, with Gumbel noise.

    Parameters
    ----------
    differences : (n, n) float64    true differences of the motions
    participants : int    number of participants
    seed : int    seed of trials and choices
    noise : float    scale of the noise, in the unit of the differences

    Returns
    -------
    Judgements    63 trials per participant
    """
    shown = draw_trials(len(differences), participants, seed).reshape(-1, SHOWN)
    utility = -differences[shown[:, _FIRST], shown[:, _SECOND]]
    utility = utility + np.random.default_rng([seed, 1]).gumbel(scale=noise, size=utility.shape)
    who = np.repeat(np.arange(participants), TRIALS)
    return Judgements(len(differences), who, shown, np.argmax(utility, axis=1))


def difference_table(judgements: Judgements) -> DifferenceTable:
    """Compute the perceived difference of each pair of motions from the choices of the most similar pairs.

    The difference is 1 minus the share of the trials with both motions in which this pair was chosen.

    Parameters
    ----------
    judgements : Judgements    answered trials

    Returns
    -------
    DifferenceTable    differences and counts of all pairs; NaN for pairs that were never shown together
    """
    n = judgements.motion_count
    shown, chosen = (counts.sum(axis=0) for counts in _counts_by_participant(judgements))
    with np.errstate(invalid="ignore"):
        differences = 1.0 - chosen / np.where(shown > 0, shown, np.nan)
    np.fill_diagonal(differences, 0.0)
    assert differences.shape == (n, n)
    return DifferenceTable(differences, shown, chosen)


def pair_counts_by_participant(judgements: Judgements) -> tuple[Ints, Ints]:
    """Count, for each participant, how often pairs of motions were shown together and chosen.

    Parameters
    ----------
    judgements : Judgements    answered trials of N participants

    Returns
    -------
    shown, chosen : (N, R) int64    counts of the R pairs i < j, in the order of `numpy.triu_indices`
    """
    pairs = np.triu_indices(judgements.motion_count, 1)
    shown, chosen = _counts_by_participant(judgements)
    return shown[:, *pairs], chosen[:, *pairs]


def triangle_violations(differences: Floats) -> tuple[int, int]:
    """Count triangle inequalities that a table violates: d(i, k) <= d(i, j) + d(j, k).

    Parameters
    ----------
    differences : (n, n) float64    symmetric table; inequalities with a missing difference are not counted

    Returns
    -------
    violated, checked : int    at most 3 · C(n, 3) are checked
    """
    n = len(differences)
    i, k = np.triu_indices(n, 1)
    direct = differences[i, k][:, None]
    around = differences[i] + differences[k]
    middle = (np.arange(n) != i[:, None]) & (np.arange(n) != k[:, None])
    known = np.isfinite(direct) & np.isfinite(around) & middle
    return int(np.count_nonzero(known & (direct > around + 1e-12))), int(np.count_nonzero(known))


def _one_draw(motion_count: int, trials: int, rng: np.random.Generator) -> Ints:
    """Chain random orders of all motions and cut them into trials (trials, 4) of different motions."""
    chain = np.empty(0, np.int64)
    while len(chain) < trials * SHOWN:
        begun = chain[len(chain) - len(chain) % SHOWN :]
        order = rng.permutation(motion_count)
        first = order[~np.isin(order, begun)][: -len(begun) % SHOWN]
        chain = np.concatenate((chain, first, order[~np.isin(order, first)]))
    return rng.permuted(rng.permutation(chain[: trials * SHOWN].reshape(trials, SHOWN)), axis=1)


def _pair_counts(shown: Ints, motion_count: int) -> Ints:
    counts = np.zeros((motion_count, motion_count), np.int64)
    np.add.at(counts, (shown[:, _FIRST], shown[:, _SECOND]), 1)
    return np.asarray(counts + counts.T)


def _counts_by_participant(judgements: Judgements) -> tuple[Ints, Ints]:
    """Count pairs shown and chosen (N, n, n), symmetric, for each of N participants."""
    n, people = judgements.motion_count, int(judgements.participants.max()) + 1
    shown, chosen = np.zeros((people, n, n), np.int64), np.zeros((people, n, n), np.int64)
    one, other = judgements.shown[:, _FIRST], judgements.shown[:, _SECOND]
    np.add.at(shown, (judgements.participants[:, None], one, other), 1)
    row = np.arange(len(one))
    np.add.at(chosen, (judgements.participants, one[row, judgements.chosen], other[row, judgements.chosen]), 1)
    return np.asarray(shown + shown.transpose(0, 2, 1)), np.asarray(chosen + chosen.transpose(0, 2, 1))
