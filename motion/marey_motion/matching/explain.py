"""Explanation of a choice of motion matching: the best candidates of one tick and their costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.matching.controller import (
    ControllerConstants,
    DatabaseArrays,
    Trajectory,
    TrajectoryArrays,
    controller_constants,
    database_arrays,
    trajectory_arrays,
)
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex
from marey_schemas.options.matching import ControllerOptions

Reason = Literal["started", "not_searched", "continued", "switched", "clip_ended"]

POSE_DISTANCE = "pose_distance"
"""Name of the group that replaces the pose features if poses are compared by the summed distance of their joints, in
metres.
"""


@dataclass(frozen=True)
class Candidate:
    """A row of the database with its cost at a tick: frame `frame` of clip `clip` (an index into the database's clips).

    `groups` is the cost of each group of features; these costs add up to `cost`. `barred` is the reason why the search
    at this tick may not choose the row, "not selectable" or "too near"; None if the search may choose the row.
    """

    row: int
    clip: int
    frame: int
    cost: float
    groups: Mapping[str, float]
    barred: str | None = None


@dataclass(frozen=True)
class Explanation:
    """Explanation of one tick of a trial.

    Parameters
    ----------
    shown : row displayed at the tick
    chosen : row after which the motion continues at the next tick; `shown` itself if its clip was continued
    sentence : explanation of the choice, as a sentence with numbers
    going_on : continuation of the displayed clip (row `shown`) as a candidate; None at the start of a trial and at the
        end of a clip
    candidates : the cheapest rows that could be chosen, cheapest first
    others : the further rows that the caller requested, in the requested order
    """

    tick: int
    time_s: float
    shown: int
    chosen: int
    reason: Reason
    sentence: str
    going_on: Candidate | None
    candidates: tuple[Candidate, ...]
    others: tuple[Candidate, ...]


def explain_choice(
    database: MatchingDatabase,
    index: SearchIndex,
    guide: Trajectory,
    options: ControllerOptions,
    record: TrialRecord,
    tick: int,
    *,
    count: int = 10,
    others: Sequence[int] = (),
) -> Explanation:
    """List the cheapest candidates at a tick of a trial, and the reason for the choice at that tick.

    At a tick without a search, the candidates are the rows that a search at this tick would have compared.

    Parameters
    ----------
    database : MatchingDatabase    the database that the trial used
    index : SearchIndex    search index of the database
    guide : trajectory    the trajectory of the trial
    options : ControllerOptions    options of the trial
    record : TrialRecord    result of `run_trial` for these arguments
    tick : int    tick to explain
    count : int    number of candidates
    others : sequence of int    further rows to list

    Returns
    -------
    Explanation    candidates with their costs by group

    Raises
    ------
    MotionError    if the tick or a row does not exist, or if the record belongs to another database
    """
    if record.rows.max(initial=0) >= database.row_count:
        raise MotionError(
            "the record of the trial belongs to another database: it contains rows that this database does not have"
        )
    if not 0 <= tick < len(record.rows):
        raise MotionError(
            f"the trial has no tick {tick}; it has {len(record.rows)} ticks, counted from 0", where="tick"
        )
    for row in others:
        if not 0 <= row < database.row_count:
            raise MotionError(
                f"the database has no row {row}; it has {database.row_count} rows, counted from 0", where="others"
            )
    desired, rules, playback = (
        trajectory_arrays(guide),
        controller_constants(options, guide.rate_hz),
        database_arrays(database),
    )
    shown = int(record.rows[tick])
    query = _query_at(index, playback, desired, rules, record, tick)
    costs = _Costs(database, index, rules, query, shown, starting=tick == 0)
    chosen, cost, reason = _chosen(index, playback, rules, query, record, tick)
    ended = playback.successors[shown] < 0
    going_on = None if tick == 0 or ended else costs.candidate(shown)
    return Explanation(
        tick=tick,
        time_s=tick / record.rate_hz,
        shown=shown,
        chosen=chosen,
        reason=reason,
        sentence=_sentence(reason, cost, going_on, options),
        going_on=going_on,
        candidates=tuple(costs.candidate(row) for row in costs.cheapest(count)),
        others=tuple(costs.candidate(row) for row in others),
    )


def _query_at(
    index: SearchIndex,
    playback: DatabaseArrays,
    desired: TrajectoryArrays,
    rules: ControllerConstants,
    record: TrialRecord,
    tick: int,
) -> Floats:
    from marey_motion.matching import controller_kernels as kernels

    moments = np.empty(tick + 1)
    kernels.moments_along(rules, desired, record.positions[: tick + 1], moments)
    query = np.empty(index.rows.shape[1])
    x, z = record.positions[tick]
    row, heading = record.rows[tick], record.headings[tick]
    kernels.fill_query(index, playback, rules, desired, row, moments[-1], x, z, heading, query)
    return query


def _chosen(
    index: SearchIndex,
    playback: DatabaseArrays,
    rules: ControllerConstants,
    query: Floats,
    record: TrialRecord,
    tick: int,
) -> tuple[int, float, Reason]:
    """Find the row that was chosen at a tick, the row's cost, and the reason; `query` is the query of the tick."""
    from marey_motion.matching import controller_kernels as kernels

    shown = int(record.rows[tick])
    if tick == 0:
        return shown, float(record.match_cost[0]), "started"
    if np.isnan(record.match_cost[tick]):
        return shown, float("nan"), "not_searched"
    chosen, cost, going_on = kernels.choose(index, playback, rules, shown, query)
    if np.isnan(going_on):
        return int(chosen), float(cost), "clip_ended"
    return int(chosen), float(cost), "continued" if chosen == shown else "switched"


def _sentence(reason: Reason, cost: float, going_on: Candidate | None, options: ControllerOptions) -> str:
    if reason == "started":
        return f"The trial started on the row whose trajectory fits best, at a cost of {cost:.4g}."
    if reason == "not_searched":
        return "No search was due: the clip went on."
    if going_on is None:
        return f"The clip had ended, so the cheapest row was taken, at a cost of {cost:.4g}."
    limit = f"{going_on.cost:.4g} for going on"
    if options.continuing_bias:
        limit += f", {options.continuing_bias:+.4g} of bias"
    limit += f", less a margin of {options.switch_margin:.4g}"
    if reason == "continued":
        return f"The clip went on: no other row was cheaper than {limit}."
    return f"Another row was chosen: it costs {cost:.4g}, which is cheaper than {limit}."


class _Costs:
    """Costs of all rows at one tick."""

    def __init__(
        self,
        database: MatchingDatabase,
        index: SearchIndex,
        rules: ControllerConstants,
        query: Floats,
        shown: int,
        *,
        starting: bool,
    ) -> None:
        self._database, self._index, self._query = database, index, query
        self._layout = database.layout
        self._by_distance = rules.by_distance and not starting
        self._first = self._layout.pose_dimensions if starting or rules.by_distance else 0
        self._points = database.pose_points.astype(np.float64)
        self._shown = shown
        clip = self._clip_of(shown)
        self._near = range(0)
        if rules.window and not starting:
            self._near = range(
                max(int(database.starts[clip]), shown - rules.window),
                min(int(database.starts[clip + 1]), shown + rules.window + 1),
            )
        self._totals = self._distances(slice(None)) if self._by_distance else np.zeros(database.row_count)
        for dimension in range(self._first, len(query)):
            self._totals += (index.rows[:, dimension] - query[dimension]) ** 2

    def cheapest(self, count: int) -> list[int]:
        costs = np.where(self._index.selectable, self._totals, np.inf)
        costs[self._near.start : self._near.stop] = np.inf
        order = np.argsort(costs, kind="stable")[:count]
        return [int(row) for row in order if np.isfinite(costs[row])]

    def candidate(self, row: int) -> Candidate:
        clip = self._clip_of(row)
        squares = (self._index.rows[row] - self._query) ** 2
        groups = {POSE_DISTANCE: float(self._distances(slice(row, row + 1))[0])} if self._by_distance else {}
        for group in self._layout.groups:
            if group.start >= self._first:
                groups[group.name] = float(squares[group.start : group.stop].sum())
        barred = None if self._index.selectable[row] else "not selectable"
        if row in self._near:
            barred = "too near"
        frame = row - int(self._database.starts[clip])
        return Candidate(row, clip, frame, float(self._totals[row]), groups, barred)

    def _distances(self, rows: slice) -> Floats:
        return np.asarray(np.linalg.norm(self._points[rows] - self._points[self._shown], axis=-1).sum(axis=-1))

    def _clip_of(self, row: int) -> int:
        return int(np.searchsorted(self._database.starts, row, side="right")) - 1
