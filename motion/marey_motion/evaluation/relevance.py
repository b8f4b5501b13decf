"""Relevance of clips and frames: their use and popularity, and the jumps from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.result import ClipUsage
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import Status, TrialRecord

TREADING_S = 1 / 3
"""A jump within a clip over at most this duration, in seconds, makes the character tread on the spot."""


class Jumps(NamedTuple):
    """Jumps of a character from one row to another row that is not the next row.

    Parameters
    ----------
    ticks : (J,) int64    the first tick after each jump
    left, entered : (J,) int64    rows displayed before and after each jump
    forced : (J,) bool    whether the jump was forced because the clip had ended; all other jumps were chosen
    """

    ticks: NDArray[np.int64]
    left: NDArray[np.int64]
    entered: NDArray[np.int64]
    forced: NDArray[np.bool_]


def clip_starts(clips: Sequence[DatabaseClip]) -> NDArray[np.int64]:
    """Compute the first row of each clip.

    Parameters
    ----------
    clips : sequence of DatabaseClip    C clips

    Returns
    -------
    (C + 1,) int64    first row of each clip, then the total number of rows
    """
    return np.array([clip.start for clip in clips] + [clips[-1].stop if clips else 0], dtype=np.int64)


def clips_of_rows(clips: Sequence[DatabaseClip], rows: NDArray[np.integer]) -> NDArray[np.int64]:
    """Find the clip that each database row belongs to.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    rows : (n,) int    database rows

    Returns
    -------
    (n,) int64    index in `clips` of each row's clip
    """
    found: NDArray[np.int64] = np.searchsorted(clip_starts(clips)[1:], rows, side="right")
    return found


def find_jumps(clips: Sequence[DatabaseClip], record: TrialRecord) -> Jumps:
    """Find every jump of a trial, in the order of time. The restart of a loop counts only if a search chose it.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    record : TrialRecord    T simulated ticks

    Returns
    -------
    Jumps    ticks and rows
    """
    rows = record.rows.astype(np.int64)
    owners = clips_of_rows(clips, rows)
    left, entered = rows[:-1], rows[1:]
    starts = clip_starts(clips)
    same = owners[1:] == owners[:-1]
    again = same & (left == starts[owners[:-1] + 1] - 1) & (entered == starts[owners[:-1]])
    chosen = record.status[1:] == Status.REPLACING
    at = np.flatnonzero(chosen | ((~same | (entered != left + 1)) & ~again))
    return Jumps(at + 1, left[at], entered[at], ~chosen[at])


@dataclass(frozen=True, eq=False)
class UsageTally:
    """Count of the use of C clips with N rows, to which runs of trials are added one after another.

    Parameters
    ----------
    popularity : (N,) int64    number of ticks that displayed each row
    entries : (C,) int64    number of jumps to each clip
    shown : mapping of str to (C,) bool    by name of the trial, True for each clip that a run of the trial displayed
    """

    popularity: NDArray[np.int64]
    entries: NDArray[np.int64]
    shown: dict[str, NDArray[np.bool_]]

    @classmethod
    def of(cls, clips: Sequence[DatabaseClip]) -> UsageTally:
        """Make a tally in which all counts are zero.

        Parameters
        ----------
        clips : sequence of DatabaseClip    the clips

        Returns
        -------
        UsageTally    zeros
        """
        return cls(np.zeros(clip_starts(clips)[-1], dtype=np.int64), np.zeros(len(clips), dtype=np.int64), {})

    @classmethod
    def total(cls, tallies: Sequence[UsageTally]) -> UsageTally:
        """Add several tallies of the same clips.

        A trial counts as having displayed a clip if it did so in any of the tallies.

        Parameters
        ----------
        tallies : sequence of UsageTally    at least one

        Returns
        -------
        UsageTally    the sum
        """
        first, *others = tallies
        total = cls(first.popularity.copy(), first.entries.copy(), dict(first.shown))
        for other in others:
            total.popularity[:] += other.popularity
            total.entries[:] += other.entries
            for trial, shown in other.shown.items():
                total.shown[trial] = shown | total.shown.get(trial, False)
        return total

    def add(self, clips: Sequence[DatabaseClip], trial: str, record: TrialRecord) -> None:
        """Add the simulated ticks of one run of a trial to the counts.

        Parameters
        ----------
        clips : sequence of DatabaseClip    the clips
        trial : str    name of the trial
        record : TrialRecord    T simulated ticks
        """
        self.popularity[:] += np.bincount(record.rows, minlength=len(self.popularity))
        shown = np.bincount(clips_of_rows(clips, record.rows), minlength=len(clips)) > 0
        self.shown[trial] = shown | self.shown.get(trial, False)
        entered = clips_of_rows(clips, find_jumps(clips, record).entered)
        self.entries[:] += np.bincount(entered, minlength=len(clips))

    def usage(self, clips: Sequence[DatabaseClip]) -> tuple[ClipUsage, ...]:
        """Compute the use of each clip: ticks, share of all ticks, jumps to the clip, and trials.

        Parameters
        ----------
        clips : sequence of DatabaseClip    the clips

        Returns
        -------
        tuple of ClipUsage    one per clip, in the order of the clips
        """
        total = max(int(self.popularity.sum()), 1)
        trials = np.zeros(len(clips), dtype=np.int64)
        for shown in self.shown.values():
            trials += shown
        usage = []
        for index, clip in enumerate(clips):
            frames = self.popularity[clip.start : clip.stop]
            ticks = int(frames.sum())
            usage.append(ClipUsage(index, ticks, ticks / total, int(self.entries[index]), int(trials[index]), frames))
        return tuple(usage)


def measure_usage(clips: Sequence[DatabaseClip], records: Sequence[TrialRecord]) -> tuple[ClipUsage, ...]:
    """Count the ticks that display each clip, and the jumps to each clip, over all trials.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    tuple of ClipUsage    one per clip, in the order of the clips
    """
    tally = UsageTally.of(clips)
    for number, record in enumerate(records):
        tally.add(clips, str(number), record)
    return tally.usage(clips)


def count_switches(clips: Sequence[DatabaseClip], records: Sequence[TrialRecord]) -> NDArray[np.int64]:
    """Count the jumps between each pair of rows, over all trials.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    (S, 3) int64    row left, row entered and count, ordered by the first two
    """
    jumps = [find_jumps(clips, record) for record in records]
    left = np.concatenate([jump.left for jump in jumps] or [np.empty(0, np.int64)])
    entered = np.concatenate([jump.entered for jump in jumps] or [np.empty(0, np.int64)])
    pairs, counts = np.unique(np.stack((left, entered), axis=1), axis=0, return_counts=True)
    return np.concatenate((pairs, counts[:, None]), axis=1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class SourceUsage:
    """Use of a source clip together with its mirrored copy.

    Parameters
    ----------
    uid, name : str    uid and name of the source clip
    clips : tuple of int    indices of the one or two clips made from it
    ticks, share, entries : sums over these clips
    popularity : (frames,) int64    number of ticks that displayed each frame, summed over these clips
    """

    uid: str
    name: str
    clips: tuple[int, ...]
    ticks: int
    share: float
    entries: int
    popularity: NDArray[np.int64]


def sum_by_source(clips: Sequence[DatabaseClip], usage: Sequence[ClipUsage]) -> tuple[SourceUsage, ...]:
    """Sum the use of clips and their mirrored copies.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    usage : sequence of ClipUsage    one per clip

    Returns
    -------
    tuple of SourceUsage    in the order of the uids
    """
    families: dict[str, list[int]] = {}
    for index, clip in enumerate(clips):
        families.setdefault(clip.mirrored_from or clip.uid, []).append(index)
    return tuple(
        SourceUsage(
            uid=uid,
            name=next((clips[index].name for index in own if clips[index].mirrored_from is None), clips[own[0]].name),
            clips=tuple(own),
            ticks=sum(usage[index].ticks for index in own),
            share=sum(usage[index].share for index in own),
            entries=sum(usage[index].entries for index in own),
            popularity=np.asarray(np.sum([usage[index].popularity for index in own], axis=0, dtype=np.int64)),
        )
        for uid, own in sorted(families.items())
    )


def recorded_rows(clips: Sequence[DatabaseClip], usage: Sequence[ClipUsage]) -> int:
    """Count the rows of the recorded clips, without mirrored copies.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    usage : sequence of ClipUsage    one per clip

    Returns
    -------
    int    rows
    """
    return sum(len(source.popularity) for source in sum_by_source(clips, usage))


def unused_clips(usage: Sequence[ClipUsage]) -> tuple[int, ...]:
    """List the clips that were never displayed.

    Parameters
    ----------
    usage : sequence of ClipUsage    one per clip

    Returns
    -------
    tuple of int    indices of the clips
    """
    return tuple(index for index, own in enumerate(usage) if own.ticks == 0)


def treading_share(clips: Sequence[DatabaseClip], records: Sequence[TrialRecord]) -> float | None:
    """Compute the share of chosen jumps that lead to a frame of the same clip at most `TREADING_S` away.

    A character without suitable data returns to nearly the same frame at every search, so its feet slide.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    float or None    0 to 1; None if no jump was chosen
    """
    made = sum(int(np.count_nonzero(record.status[1:] == Status.REPLACING)) for record in records)
    back = sum(int(np.count_nonzero(treading_steps(clips, record))) for record in records)
    return back / made if made else None


def treading_steps(clips: Sequence[DatabaseClip], record: TrialRecord) -> NDArray[np.bool_]:
    """Mark the chosen jumps of a trial that lead to a frame of the same clip at most `TREADING_S` away.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    record : TrialRecord    T simulated ticks

    Returns
    -------
    (T - 1,) bool    True if such a jump leads from a tick to the next
    """
    rows = record.rows.astype(np.int64)
    back: NDArray[np.bool_] = record.status[1:] == Status.REPLACING
    back &= np.abs(np.diff(rows)) <= TREADING_S * record.rate_hz
    at = np.flatnonzero(back)
    back[at] = clips_of_rows(clips, rows[at]) == clips_of_rows(clips, rows[at + 1])
    return back
