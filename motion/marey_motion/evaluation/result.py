"""Content of an evaluation: its conditions, the record of every trial, and the measures computed from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.scenario import Trial
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions

Metrics = Mapping[str, float | None]
"""Value by name, in the unit the name ends with; None where it is not defined, as a response time that never came."""


@dataclass(frozen=True)
class TrialResult:
    """One trial: its metrics, and those of each regime of a switching one ("base", "switched")."""

    trial: Trial
    metrics: Metrics
    regimes: Mapping[str, Metrics] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ClipUsage:
    """Use of one clip in the suite; indices are into `EvaluationResult.clips`.

    Parameters
    ----------
    ticks, entries : ticks displayed; times jumped to, by choice or because another clip had ended
    popularity : (frames,) int64    ticks each frame was displayed
    trials : number of trials that displayed it
    """

    clip: int
    ticks: int
    share: float
    entries: int
    trials: int
    popularity: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Coverage:
    """Speeds and turn rates of the clips, by windows of one second.

    Parameters
    ----------
    clip : (W,) int32    index of the clip of each window
    speed_m_s, turn_rate_rad_s, forward_m_s, strafe_m_s : (W,) float64    strafe positive to the left
    speed_edges_m_s, turn_rate_edges_deg_s : (V + 1,), (O + 1,)    cells centred on the trial grid
    seconds : (V, O) float64    seconds of data in each cell
    deficit_s : (V, O) float64    seconds that each cell lacks
    index : share of target cells with enough
    symmetry : 1 where turning left and right are covered alike, 0 where only one is
    too_short : indices of clips under a second
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
    """Conditions that must agree to compare two results, and their origin. All digests are "sha256:…"."""

    dataset: str
    clips: Mapping[str, str]
    normaliser: str
    options: str
    scenarios: str
    code_version: str


@dataclass(frozen=True, eq=False)
class EvaluationResult:
    """A suite of trials over one database.

    Parameters
    ----------
    suite : pooled metrics over all trials, and by family under "circle.…" and "switching.…"
    usage : one per clip, in the order of `clips`
    switches : (S, 3) int64    row left, row entered, how often, of all jumps of the suite; ordered by the first two
    records : one per trial, in the order of `trials`
    baseline : the same suite over generated clips that own every cell of the grid, without records; None when left out
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
