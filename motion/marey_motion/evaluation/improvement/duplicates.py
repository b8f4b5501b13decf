"""Near-duplicates: clips with nearly the same poses in the same order and nearly the same path of the root.

Two frames are compared by points relative to the root: the pose joints, and the future root at each horizon, so that
walks with equal poses but different turns differ. The distance of two clips is computed from their best alignment in
time (`alignment.dtw`): the mean distance between points is summed over the aligned frames and divided by the number of
frames of the longer clip. The distance is in metres; it is 0 for the same frames of clips with equal content.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.dtw import RangeBounds, distance_bound, warped_distance
from marey_motion.evaluation.improvement.selection import clips_by_source, source_of
from marey_motion.evaluation.perceived import PerceivedRows
from marey_motion.evaluation.running import CancelCallback, EvaluationCancelled
from marey_motion.matching.database import DatabaseClip, MatchingDatabase

ProgressCallback = Callable[[int, int, str], None]


@dataclass(frozen=True)
class NearDuplicate:
    """Pair of source clips with nearly the same motion, or with motions that are nearly mirror images.

    Parameters
    ----------
    first, second : uids of the source clips
    first_name, second_name : names of the clips
    distance_cm : distance of the two motions in centimetres: the mean distances of corresponding points, summed along
        the best alignment in time and divided by the frames of the longer clip
    same_content : whether both are the same frames of clips with equal content
    mirrored : whether the first motion is nearly the mirror image of the second
    perceived : perceptual distance of the two motions; None without a metric
    """

    first: str
    second: str
    first_name: str
    second_name: str
    distance_cm: float
    same_content: bool
    mirrored: bool
    perceived: float | None = None


@dataclass(frozen=True)
class NearDuplicates:
    """Near-duplicates of a set of clips.

    `pairs` lists the pairs within `threshold_cm`, the nearest first. `compared` is the number of all pairs, and
    `aligned` the number of pairs whose distance had to be computed by an alignment.
    """

    pairs: tuple[NearDuplicate, ...]
    threshold_cm: float
    aligned: int
    compared: int


def find_near_duplicates(
    database: MatchingDatabase,
    *,
    threshold_cm: float,
    perceived_rows: PerceivedRows | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> NearDuplicates:
    """Find all pairs of source clips whose distance is at most the threshold.

    The result is exact: lower bounds of the distance rule out most pairs without alignment. Progress counts sources.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    threshold_cm : float    greatest distance of near-duplicates (`NearDuplicate.distance_cm`), centimetres
    perceived_rows : PerceivedRows, optional    rows of `database`, prepared for a perceptual metric; if given, the
        perceptual distance of each pair is computed, too
    threads : int, optional    threads to use, one per processor if None
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    NearDuplicates    pairs, the nearest first

    Raises
    ------
    EvaluationCancelled    if cancelled
    """
    families = _Families(database, perceived_rows)
    found: list[NearDuplicate] = []
    aligned = compared = 0

    def compare(number: int) -> tuple[list[NearDuplicate], int, int]:
        return families.compared(number, threshold_cm / 100.0)

    with ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1, thread_name_prefix="pairs") as pool:
        for number, (pairs, own_aligned, own_compared) in enumerate(pool.map(compare, range(families.count))):
            found += pairs
            aligned, compared = aligned + own_aligned, compared + own_compared
            if progress is not None:
                progress(number + 1, families.count, families.source(number))
            if cancelled is not None and cancelled():
                pool.shutdown(cancel_futures=True)
                raise EvaluationCancelled(
                    f"the search for duplicates was stopped after {number + 1} of {families.count} clips"
                )
    found.sort(key=lambda pair: (pair.distance_cm, pair.first, pair.second))
    return NearDuplicates(tuple(found), threshold_cm, aligned, compared)


class _Families:
    """The clips of a database, grouped by source: a clip and its mirrored copy have the same source."""

    def __init__(self, database: MatchingDatabase, perceived_rows: PerceivedRows | None) -> None:
        self._perceived_rows = perceived_rows
        families = clips_by_source(database.clips).values()
        self._clips = [database.clips[index] for own in families for index in own]
        self._family = np.repeat(np.arange(len(families)), [len(own) for own in families])
        self._first = np.append(np.flatnonzero(np.diff(self._family, prepend=-1)), len(self._clips))
        self._points = frame_points(database)
        starts, stops = (np.array([getattr(clip, end) for clip in self._clips]) for end in ("start", "stop"))
        self._bounds = RangeBounds(self._points, starts, stops)

    @property
    def count(self) -> int:
        return len(self._first) - 1

    def source(self, number: int) -> str:
        return source_of(self._clips[self._first[number]])

    def compared(self, number: int, limit_m: float) -> tuple[list[NearDuplicate], int, int]:
        """Find the near-duplicates of source `number` among later sources, up to the distance `limit_m` per frame.

        Returns the near-duplicates, the number of clips that were aligned with the source, and the number of all later
        clips. The source is compared with the later sources and with their mirrored copies. The mirrored copy of source
        `number` is not compared, because mirroring both clips of a pair does not change their distance.
        """
        one, others = self._first[number], np.arange(self._first[number + 1], len(self._clips))
        near: dict[int, list[NearDuplicate]] = {}
        aligned = 0
        for place in others[self._bounds.between(one, others, limit=limit_m) <= limit_m]:
            own, theirs = self._frames(one), self._frames(place)
            if distance_bound(own, theirs) > limit_m:
                continue
            aligned += 1
            distance = warped_distance(own, theirs, limit=limit_m)
            if distance <= limit_m:
                perceived = (
                    None
                    if self._perceived_rows is None
                    else self._perceived_rows.distance(self._clips[one], self._clips[place])
                )
                pair = _pair(self._clips[one], self._clips[place], distance, perceived)
                near.setdefault(self._family[place], []).append(pair)
        nearest = [min(pairs, key=lambda pair: pair.distance_cm) for pairs in near.values()]
        return nearest, aligned, len(others)

    def _frames(self, place: int) -> NDArray[np.float64]:
        clip = self._clips[place]
        return self._points[clip.start : clip.stop]


def frame_points(database: MatchingDatabase) -> NDArray[np.float64]:
    """Compute the positions of the pose joints, and of the future root at each horizon, for each row of a database.

    Parameters
    ----------
    database : MatchingDatabase    N rows, P pose joints, H horizons

    Returns
    -------
    (N, P + H, 3) float64    metres in the frame of each row's root
    """
    horizons = len(database.options.horizons_s)
    first = database.features.shape[1] - 4 * horizons
    ahead = np.zeros((database.row_count, horizons, 3))
    ahead[..., (0, 2)] = database.features[:, first : first + 2 * horizons].reshape(-1, horizons, 2)
    return np.concatenate((database.pose_points.astype(np.float64), ahead), axis=1)


def spared_sources(
    database: MatchingDatabase, duplicates: NearDuplicates, ticks: dict[str, int], *, most_perceived: float = np.inf
) -> tuple[tuple[str, NearDuplicate], ...]:
    """Choose the source clips that can be spared: after their removal, no near-duplicates that look alike are left.

    Of each pair, the source that is displayed for fewer ticks is removed. If the numbers of ticks are equal, the
    shorter source is removed; if the durations are equal, too, the source with the higher uid is removed.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    duplicates : NearDuplicates    the pairs
    ticks : mapping of str to int    number of ticks for which each source is displayed, by uid
    most_perceived : float    pairs with a greater perceptual distance look different, so both of their clips stay

    Returns
    -------
    tuple of (str, NearDuplicate)    each source to remove, with the pair whose other source stays
    """
    families = clips_by_source(database.clips)
    frames = {source: database.clips[own[0]].frame_count for source, own in families.items()}
    gone: dict[str, NearDuplicate] = {}
    for pair in duplicates.pairs:
        alike = pair.perceived is None or pair.perceived <= most_perceived
        if alike and pair.first not in gone and pair.second not in gone:
            worth = {source: (ticks.get(source, 0), frames[source]) for source in (pair.first, pair.second)}
            gone[pair.first if worth[pair.first] < worth[pair.second] else pair.second] = pair
    return tuple(gone.items())


def _pair(one: DatabaseClip, other: DatabaseClip, distance: float, perceived: float | None) -> NearDuplicate:
    mirrored = (one.mirrored_from is None) != (other.mirrored_from is None)
    return NearDuplicate(
        first=source_of(one),
        second=source_of(other),
        first_name=one.name,
        second_name=other.name,
        distance_cm=100.0 * distance,
        same_content=distance == 0.0 and one.content == other.content != "" and not mirrored,
        mirrored=mirrored,
        perceived=perceived,
    )
