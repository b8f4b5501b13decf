"""Perceptual distances between all clips of a set: preparation of the clips, and the table of distances."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Literal, Self

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.looping import loop_seam
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.simulation_root import raw_root
from marey_motion.motion import Motion
from marey_motion.perception.cycles import Period, cut_loop, find_period
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.perception.registration import ClipDistance, clip_distance
from marey_motion.resampling import resample_motion

MOST_COMPARED_FRAMES = 3600
"""Greatest number of frames of a clip, at the rate of the metric."""
MOST_TABLE_CELLS = 2_000_000_000
"""Greatest number of cells in all motion maps together that are computed for one table of distances."""

Progress = Callable[[float, float | None, str], None]


@dataclass(frozen=True, eq=False)
class ComparableClip:
    """A clip that is ready to be compared.

    Parameters
    ----------
    name : str    name shown to users
    recorded : MeasuredClip    the whole clip
    compared : MeasuredClip    the part that is compared: a loop of one cycle, or the whole clip
    motion : Motion    the motion from which `compared` was measured
    period : Period, optional    period and start of the loop that was cut out of the clip; None if no loop was cut
    """

    name: str
    recorded: MeasuredClip
    compared: MeasuredClip
    motion: Motion
    period: Period | None


@dataclass(frozen=True, eq=False)
class ClipDistances:
    """Distances of all pairs of N clips.

    Parameters
    ----------
    totals : (N, N) float64    perceptual distances, symmetric, 0 on the diagonal
    by_component : (C, N, N) float64    distances by each of the C components of the metric alone, before the
        multiplication by the component's share in the total
    """

    totals: Floats
    by_component: Floats

    @classmethod
    def of(cls, count: int, pairs: Ints, found: Floats) -> Self:
        """Make the tables of distances.

        Parameters
        ----------
        count : int    number of clips N
        pairs : (R, 2) int64    all pairs of the clips, each once
        found : (R, 1 + C) float64    total distance of each pair, then its distance by each of the C components

        Returns
        -------
        ClipDistances    symmetric tables
        """
        tables = np.zeros((found.shape[1], count, count))
        for i, j in (pairs.T, pairs.T[::-1]):
            tables[:, i, j] = found.T
        return cls(tables[0], tables[1:])

    def pairs_by_distance(self) -> Ints:
        """List the pairs i < j, the nearest first.

        Returns
        -------
        (N (N - 1) / 2, 2) int64    pairs of clips
        """
        pairs = np.stack(np.triu_indices(len(self.totals), 1), axis=1)
        return pairs[np.argsort(self.totals[tuple(pairs.T)], kind="stable")]


def measure_clip(clip: Clip, body: MatchingBody, rate_hz: float, *, loop: bool) -> tuple[Motion, MeasuredClip]:
    """Measure a whole clip at the rate of a metric.

    Parameters
    ----------
    clip : Clip    the clip
    body : MatchingBody    body of its skeleton
    rate_hz : float    frame rate at which the metric measures clips
    loop : bool    whether the clip is a loop

    Returns
    -------
    Motion    the motion at this rate
    MeasuredClip    its measurements
    """
    motion, seam = Motion.of(clip), None
    if loop:
        root = raw_root(motion.positions(body.skeleton), body)
        seam = loop_seam(root.positions, np.unwrap(root.headings))
    motion = resample_motion(motion, clip.frame_rate_hz, rate_hz, seam=seam)
    return motion, measure_motion(motion, body, rate_hz, seam=seam)


def prepare_comparison(
    clip: Clip,
    body: MatchingBody,
    metric: PerceptualMetric,
    rate_hz: float,
    *,
    name: str,
    cycles: Literal["cut", "whole"] = "cut",
    loop: bool = False,
) -> ComparableClip:
    """Measure a clip at the rate of a metric; if `cycles` is "cut", also cut a loop of one cycle out of the clip.

    Parameters
    ----------
    clip : Clip    the clip
    body : MatchingBody    body of its skeleton
    metric : PerceptualMetric    the metric
    rate_hz : float    frame rate at which the metric measures clips
    name : str    name shown to users
    cycles : str    "cut" compares a loop of one cycle, "whole" compares the whole clip
    loop : bool    True if the clip is a loop already; such a clip is never cut

    Returns
    -------
    ComparableClip    the clip with its measurements

    Raises
    ------
    MotionError    if the clip is too long, or no cycle is found in it
    """
    frames = clip.frame_count * rate_hz / clip.frame_rate_hz
    if frames > MOST_COMPARED_FRAMES:
        raise MotionError(
            f"the clip has {frames:,.0f} frames at {rate_hz:g} Hz, and at most {MOST_COMPARED_FRAMES:,} can be "
            "compared; cut it first",
            code="too-many-frames",
        )
    motion, recorded = measure_clip(clip, body, rate_hz, loop=loop)
    if loop or cycles == "whole":
        return ComparableClip(name, recorded, recorded, motion, None)
    period = find_period(recorded, metric)
    cut, seam = cut_loop(motion, body, period)
    return ComparableClip(name, recorded, measure_motion(cut, body, rate_hz, seam=seam), cut, period)


def compare_clips(
    clips: Sequence[MeasuredClip], metric: PerceptualMetric, *, threads: int = 1, progress: Progress | None = None
) -> ClipDistances:
    """Compute the perceptual distances of all pairs of clips.

    Parameters
    ----------
    clips : sequence of MeasuredClip    N clips
    metric : PerceptualMetric    the metric
    threads : int    number of threads
    progress : callable, optional    called with the number of pairs done, the number of all pairs, and a note

    Returns
    -------
    ClipDistances    distances of all pairs

    Raises
    ------
    MotionError    if clips cannot be compared, or the motion maps of all pairs have more than `MOST_TABLE_CELLS` cells
    """
    pairs = np.stack(np.triu_indices(len(clips), 1), axis=1)
    by_number = dict(enumerate(clips))
    return ClipDistances.of(
        len(clips), pairs, compare_pairs(by_number, pairs, metric, threads=threads, progress=progress)
    )


def compare_pairs(
    clips: Mapping[int, MeasuredClip],
    pairs: Ints,
    metric: PerceptualMetric,
    *,
    threads: int = 1,
    progress: Progress | None = None,
) -> Floats:
    """Compute the perceptual distances of some pairs of clips.

    Parameters
    ----------
    clips : mapping of int to MeasuredClip    clips by number
    pairs : (R, 2) int64    numbers of the clips of each pair
    metric : PerceptualMetric    metric of C components
    threads : int    number of threads
    progress : callable, optional    called with the number of pairs done, the number of all pairs, and a note

    Returns
    -------
    (R, 1 + C) float64    total distance of each pair, then its distance by each component alone, before the
        multiplication by the component's share in the total

    Raises
    ------
    MotionError    if clips cannot be compared, or the motion maps of the pairs have more than `MOST_TABLE_CELLS` cells
    """
    cells = sum(clips[int(i)].frame_count * clips[int(j)].frame_count for i, j in pairs)
    if cells > MOST_TABLE_CELLS:
        raise MotionError(
            f"the motion maps of {len(pairs):,} pairs would have {cells:,} cells, and at most {MOST_TABLE_CELLS:,} can "
            "be computed; compare fewer or shorter clips",
            code="too-many-frames",
        )
    found = np.empty((len(pairs), 1 + len(metric.components)))
    with ThreadPoolExecutor(threads) as pool:
        for done, distance in enumerate(pool.map(partial(_distance, clips, metric), pairs.tolist())):
            found[done] = distance.total, *distance.by_component
            if progress is not None:
                progress(done + 1, len(pairs), f"comparing {len(clips)} clips")
    return found


def _distance(clips: Mapping[int, MeasuredClip], metric: PerceptualMetric, pair: tuple[int, int]) -> ClipDistance:
    one, other = (clips[number] for number in pair)
    try:
        return clip_distance(one, other, metric)
    except MotionError as error:
        if error.code != "alignment-impossible":
            raise
        raise MotionError(
            f"clips {pair[0] + 1} and {pair[1] + 1} have {one.frame_count} and {other.frame_count} frames; the frames "
            "of clips whose lengths differ so much cannot be matched; compare loops of one cycle, or cut the longer "
            "clip",
            code="lengths-differ",
        ) from error
