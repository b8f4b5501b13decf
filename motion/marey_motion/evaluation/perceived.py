"""Perceptual distances in an evaluation: of transitions, and of clips that may be near-duplicates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from marey_motion.arrays import Floats, Indices, Ints
from marey_motion.errors import MotionError
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.motion import Motion
from marey_motion.perception.maps import map_blocks, paired_distances
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import metric_of
from marey_motion.perception.registration import clip_distance
from marey_schemas.documents.metrics import MetricDocument, MetricIdentity


@dataclass(frozen=True)
class PerceivedTransitions:
    """Perceptual distances of jumps, from the pose that would have followed to the pose that the jump entered.

    Parameters
    ----------
    metric : str    name of the metric, for people
    digest : str    digest of the parts of the metric that determine its distances
    transitions : int    number of jumps, over all trials
    mean, median, p95 : float or None    mean, median and 95th percentile of their distances, without unit; 0 is a jump
        that nobody sees. None if there are no jumps
    """

    metric: str
    digest: str
    transitions: int
    mean: float | None
    median: float | None
    p95: float | None

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any] | None) -> PerceivedTransitions | None:
        """Read the result from the document of an evaluation.

        Parameters
        ----------
        tree : mapping or None    member `perceived` of the document; None if no metric was chosen

        Returns
        -------
        PerceivedTransitions or None    the result
        """
        return None if tree is None else cls(**{field.name: tree[field.name] for field in fields(cls)})


class PerceivedRows:
    """Rows of a database, prepared for measuring distances by a perceptual metric.

    Parameters
    ----------
    database : MatchingDatabase    N rows
    metric : MetricDocument    metric whose frame rate is that of the database

    Raises
    ------
    MotionError    if the frame rates differ, or the skeleton lacks the joints that the metric compares
    """

    def __init__(self, database: MatchingDatabase, metric: MetricDocument) -> None:
        if metric.frame_rate_hz != database.options.rate_hz:
            raise MotionError(
                f"the metric {metric.name} measures at {metric.frame_rate_hz:g} Hz, and the database has "
                f"{database.options.rate_hz:g} Hz; choose a metric or a database of the same rate",
                code="metric-of-other-rate",
            )
        self._database, self._metric, self.document = database, metric_of(metric), metric

    def transitions(self, switches: Ints) -> PerceivedTransitions:
        """Compare the poses that jumps entered with the poses that would have followed without the jump.

        Parameters
        ----------
        switches : (S, 3) int64    row before each jump, row after it, and number of such jumps

        Returns
        -------
        PerceivedTransitions    distances of all jumps
        """
        successors = self._database.root_motion.successors[switches[:, 0]]
        following = np.where(successors < 0, switches[:, 0], successors)
        found = np.repeat(paired_distances(self._at(following), self._at(switches[:, 1]), self._metric), switches[:, 2])
        known = MetricIdentity.of(self.document)
        if not len(found):
            return PerceivedTransitions(known.name, known.digest, 0, None, None, None)
        median, p95 = (float(each) for each in np.quantile(found, (0.5, 0.95)))
        return PerceivedTransitions(known.name, known.digest, len(found), float(found.mean()), median, p95)

    def distance(self, one: DatabaseClip, other: DatabaseClip) -> float:
        """Compute the perceptual distance of two clips of the database, from their first to their last rows.

        Parameters
        ----------
        one, other : DatabaseClip    clips

        Returns
        -------
        float    without unit; infinite if their lengths differ too much for the slope limit of the registration
        """
        try:
            first, second = (self._at(np.arange(each.start, each.stop)) for each in (one, other))
            return clip_distance(first, second, self._metric).total
        except MotionError as error:
            if error.code != "alignment-impossible":
                raise
            return np.inf

    def blocks(self, rows: Ints, others: PerceivedRows, other_rows: Ints) -> Iterator[tuple[int, Floats]]:
        """Compute the distances of rows from rows of this or of another database, in blocks.

        Parameters
        ----------
        rows : (n,) int64    rows of this database
        others : PerceivedRows    rows of a database with the same skeleton
        other_rows : (m,) int64    rows of that database

        Yields
        ------
        start : int    place of the block's first row in `rows`
        block : (r, m) float64    distances, without unit
        """
        return map_blocks(self._at(rows), others._at(other_rows), self._metric)

    def nearest(self, rows: Ints, groups: Ints, others: PerceivedRows, other_rows: Ints, other_groups: Ints) -> Floats:
        """Compute the distance of each row from the nearest row of another group.

        Parameters
        ----------
        rows, groups : (n,) int64    rows of this database, and their groups
        others : PerceivedRows    rows of a database with the same skeleton
        other_rows, other_groups : (m,) int64    rows of that database, and their groups

        Returns
        -------
        (n,) float64    without unit; infinite if there is no other group
        """
        found = np.full(len(rows), np.inf)
        if len(rows) and len(other_rows):
            for start, block in self.blocks(rows, others, other_rows):
                here = slice(start, start + len(block))
                block[groups[here, None] == other_groups] = np.inf
                found[here] = block.min(axis=1)
        return found

    def _at(self, rows: Indices) -> MeasuredClip:
        return self._measured.at(rows.astype(np.float64))

    @cached_property
    def _measured(self) -> MeasuredClip:
        """The rows of all clips of the database, measured clip by clip and joined in the order of the rows."""
        parts = [self._measured_clip(clip) for clip in self._database.clips]
        first = parts[0]
        return replace(
            first,
            rotations=np.concatenate([part.rotations for part in parts]),
            positions=np.concatenate([part.positions for part in parts]),
            velocities=np.concatenate([part.velocities for part in parts]),
        )

    def _measured_clip(self, clip: DatabaseClip) -> MeasuredClip:
        database, rows = self._database, slice(clip.start, clip.stop)
        poses = database.poses[rows].astype(np.float64)
        count = len(poses)
        moved = np.zeros((count, 0, 3)) if database.translations is None else database.translations[rows]
        rotations = poses[:, 3:].reshape(count, -1, 4)
        motion = Motion(poses[:, :3], rotations, moved.astype(np.float64), tuple(database.translated_joints))
        return measure_motion(motion, database.body, database.options.rate_hz)


def indistinguishable(metric: MetricDocument) -> float:
    """Compute the perceptual distance up to which two motions count as looking the same.

    Parameters
    ----------
    metric : MetricDocument    the metric

    Returns
    -------
    float    the metric's constant cost of any difference, plus twice the standard error of the human judgements
    """
    constant = sum(one.share * one.constant for one in metric.components)
    return constant + 2.0 * metric.judgement_error


def require_same_metric(before: PerceivedTransitions | None, after: PerceivedTransitions | None) -> None:
    """Check that two evaluations used the same perceptual metric.

    The check passes if one of the evaluations used no metric.

    Parameters
    ----------
    before, after : PerceivedTransitions or None    transitions of each evaluation; None if no metric was chosen

    Raises
    ------
    MotionError    if the metrics differ
    """
    if before is not None and after is not None and before.digest != after.digest:
        same_name = before.metric == after.metric
        names = f"both called {before.metric}" if same_name else f"{before.metric} and {after.metric}"
        raise MotionError(
            f"the evaluations use different perceptual metrics ({names}), so their distances cannot be compared; run "
            "one evaluation again with the metric of the other one (--metric: the name of a built-in metric, or "
            "project/folder/name)",
            code="not-comparable",
            where="metric",
        )
