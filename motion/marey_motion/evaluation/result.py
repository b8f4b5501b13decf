"""Content of an evaluation: its conditions, the simulated ticks of every trial, and the metrics of the ticks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.perceived import PerceivedTransitions
from marey_motion.evaluation.scenario import Trial
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import TrialRecord
from marey_schemas.documents.replicates import MeanInterval, mean_interval
from marey_schemas.options.evaluation import EvaluationOptions

Metrics = Mapping[str, float | None]
"""Value of each metric by name; docs/explanation/evaluation.md lists the units. None if a metric is undefined: for
example, the response time if there was no response.
"""


@dataclass(frozen=True)
class TrialResult:
    """Metrics of one trial, and of each regime (`metrics.REGIMES`) if several regimes are measured."""

    trial: Trial
    metrics: Metrics
    regimes: Mapping[str, Metrics] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ReplicateValues:
    """Metrics of T trials in each of R replicates, and of the whole suite; NaN where a metric is not defined.

    Parameters
    ----------
    names : names of the M metrics of trials
    values : (T, R, M) float64    in the unit of each metric
    followed : (T, R) bool    whether the character kept within all limits
    suite : (R,) float64 for each metric of the suite, by name
    """

    names: tuple[str, ...]
    values: NDArray[np.float64]
    followed: NDArray[np.bool_]
    suite: Mapping[str, NDArray[np.float64]]

    @property
    def count(self) -> int:
        """The number R of replicates."""
        return int(self.values.shape[1])

    def of_trials(self, metric: str) -> NDArray[np.float64]:
        """Return one metric of each trial in each replicate.

        Parameters
        ----------
        metric : str    one of `names`

        Returns
        -------
        (T, R) float64    in the unit of the metric
        """
        return self.values[:, :, self.names.index(metric)]

    def interval(self, metric: str) -> MeanInterval | None:
        """Return the mean of a metric of the suite over the replicates with its 95 % interval.

        Parameters
        ----------
        metric : str    name of the metric

        Returns
        -------
        MeanInterval or None    None if the metric is not defined
        """
        return interval_of(self.suite.get(metric, np.empty(0)))


def interval_of(values: NDArray[np.float64]) -> MeanInterval | None:
    """Return the mean of the values of replicates with its 95 % interval; values that are not defined are left out.

    Parameters
    ----------
    values : (R,) float64    a metric in each replicate, NaN where it is not defined

    Returns
    -------
    MeanInterval or None    None if no value is defined
    """
    known = values[np.isfinite(values)].tolist()
    return mean_interval(known) if known else None


@dataclass(frozen=True, eq=False)
class ClipUsage:
    """Use of one clip in the suite; `clip` is an index of `EvaluationResult.clips`.

    Parameters
    ----------
    ticks : number of ticks in which the clip was displayed
    share : share of all ticks of the suite, 0 to 1
    entries : number of jumps to the clip, chosen or forced by the end of a clip
    trials : number of trials in which the clip was displayed, in any of their replicates
    popularity : (frames,) int64    number of ticks in which each frame was displayed
    """

    clip: int
    ticks: int
    share: float
    entries: int
    trials: int
    popularity: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Coverage:
    """Speeds and turn rates of the clips in windows of one second, and the seconds of data in each cell of the grid.

    Parameters
    ----------
    clip : (W,) int32    index of the clip of each window
    speed_m_s, turn_rate_rad_s, forward_m_s, strafe_m_s : (W,) float64    means of each window; strafe is positive to
        the left
    speed_edges_m_s, turn_rate_edges_deg_s : (V + 1,), (O + 1,)    edges of the cells, which are centred on the trial
        grid
    seconds : (V, O) float64    seconds of data in each cell
    deficit_s : (V, O) float64    seconds that each cell lacks
    index : share of the cells with enough data, 0 to 1
    symmetry : 1 if left and right turns are covered equally, 0 if only one side is covered
    too_short : indices of the clips that have no window, because they last one second or less
    """

    clip: NDArray[np.int32]
    speed_m_s: NDArray[np.float64]
    turn_rate_rad_s: NDArray[np.float64]
    forward_m_s: NDArray[np.float64]
    strafe_m_s: NDArray[np.float64]
    speed_edges_m_s: NDArray[np.float64]
    turn_rate_edges_deg_s: NDArray[np.float64]
    seconds: NDArray[np.float64]
    deficit_s: NDArray[np.float64]
    index: float
    symmetry: float
    too_short: tuple[int, ...]


@dataclass(frozen=True)
class Provenance:
    """Digests ("sha256:…") of the data of an evaluation and of the conditions that comparable evaluations share.

    `limits` is "" in results of versions that did not measure looks.
    """

    dataset: str
    clips: Mapping[str, str]
    normaliser: str
    options: str
    scenarios: str
    code_version: str
    limits: str = ""


@dataclass(frozen=True, eq=False)
class EvaluationResult:
    """Result of a suite of trials over one database.

    Parameters
    ----------
    trials : metrics of each trial; if there are replicates, the means over the replicates
    suite : pooled metrics over all trials, and over each family under names such as "circle.offset_mean"; if there are
        replicates, the means of the values of the replicates
    usage : use of each clip, in the order of `clips`
    switches : (S, 3) int64    for each pair of rows between which the suite jumped: the row before the jump, the
        row after it, and the number of these jumps; ordered by the first two
    records : simulated ticks of each trial, in the order of `trials`; if there are replicates, of the first one; empty
        if they were not read. `switches` are counted over these ticks, and `usage` over those of all replicates
    replicates : metrics of each replicate; None if there is only one
    perceived : perceptual distances of the jumps; None if no perceptual metric was chosen
    notes : remarks on data that were left out or look doubtful
    baseline : result of the same suite over clips generated for every cell of the grid, without records; None if not
        computed
    """

    options: EvaluationOptions
    provenance: Provenance
    clips: tuple[DatabaseClip, ...]
    trials: tuple[TrialResult, ...]
    suite: Metrics
    usage: tuple[ClipUsage, ...]
    switches: NDArray[np.int64]
    coverage: Coverage
    records: tuple[TrialRecord, ...]
    baseline: EvaluationResult | None = None
    notes: tuple[str, ...] = ()
    perceived: PerceivedTransitions | None = None
    replicates: ReplicateValues | None = None
