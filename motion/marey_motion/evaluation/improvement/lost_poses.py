"""Poses that a set loses if clips are removed: poses that look like no pose of the remaining clips."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags
from marey_motion.evaluation.improvement.selection import clips_by_source
from marey_motion.evaluation.perceived import PerceivedRows
from marey_motion.evaluation.running import CancelCallback, EvaluationCancelled
from marey_motion.evaluation.similarity import source_of_rows
from marey_motion.matching.database import MatchingDatabase

ProgressCallback = Callable[[int, int, str], None]

MOST_POSES = 4_000
"""Maximum number of poses that are compared with all other poses of a set.

If the set has more poses, every k-th pose of each clip is compared.
"""


class LostPoses:
    """Comparison of the poses of each source clip with the poses of every other source clip by a perceptual metric.

    A clip and its mirrored copy are one source. The poses of mirrored copies are not counted, but a pose that looks
    like one of them is not lost.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    perceived_rows : PerceivedRows    its rows, prepared for the perceptual metric
    threshold : float    greatest distance of poses that replace each other
    most_poses : int    number of poses to compare, at least one of each clip
    progress : callable, optional    called as progress(poses done, total, name)
    cancelled : callable, optional    returns True to stop

    Raises
    ------
    EvaluationCancelled    if cancelled
    """

    def __init__(
        self,
        database: MatchingDatabase,
        perceived_rows: PerceivedRows,
        threshold: float,
        *,
        most_poses: int = MOST_POSES,
        progress: ProgressCallback | None = None,
        cancelled: CancelCallback | None = None,
    ) -> None:
        families = clips_by_source(database.clips)
        self._sources = tuple(families)
        own = [database.clips[min(indices, key=lambda one: database.clips[one].mirrored_from is not None)]
               for indices in families.values()]  # fmt: skip
        step = max(1, -(-sum(clip.frame_count for clip in own) // most_poses))
        parts = [np.arange(clip.start, clip.stop, step) for clip in own]
        self._source = np.repeat(np.arange(len(own)), [len(part) for part in parts])
        self._seconds = np.repeat(
            [clip.frame_count / len(part) / database.options.rate_hz for clip, part in zip(own, parts, strict=True)],
            [len(part) for part in parts],
        )
        rows, total = np.concatenate(parts), len(self._source)
        self._alike: Flags = np.zeros((total, len(own)), np.bool_)
        """Whether a source has a pose within the threshold of each compared pose."""
        ordered, firsts = _rows_by_source(database)
        for start, block in perceived_rows.blocks(rows, perceived_rows, ordered):
            if cancelled is not None and cancelled():
                raise EvaluationCancelled(f"the comparison was stopped after {start} of {total} poses")
            self._alike[start : start + len(block)] = np.minimum.reduceat(block, firsts, axis=1) <= threshold
            if progress is not None:
                progress(start + len(block), total, "")

    def seconds(self, removed: Collection[str]) -> float:
        """Compute the seconds of poses that are lost if some source clips and their mirrored copies are removed.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        float    seconds, without mirrored copies
        """
        gone = np.isin(self._sources, list(removed))
        lost = gone[self._source] & ~self._alike[:, ~gone].any(axis=1)
        return float(self._seconds[lost].sum())

    def replaced_share(self, source: str, removed: Collection[str]) -> float:
        """Compute the share of a clip's poses that look like a pose of the clips that remain.

        Parameters
        ----------
        source : str    uid of the clip
        removed : collection of str    uids of the removed clips; the clip itself counts as removed, too

        Returns
        -------
        float    0 to 1
        """
        number = self._sources.index(source)
        left = ~np.isin(self._sources, [*removed, source])
        return float(self._alike[self._source == number][:, left].any(axis=1).mean())


def _rows_by_source(database: MatchingDatabase) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the rows of a database source by source, and the place of each source's first row in the list."""
    source = source_of_rows(database)
    order = np.argsort(source, kind="stable")
    return order, np.flatnonzero(np.diff(source[order], prepend=-1))
