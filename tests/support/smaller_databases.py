"""Databases without some clips or rows, to check predictions of what the removal of clips or rows does."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from marey_motion.arrays import Flags
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.selection import rows_of_sources
from marey_motion.matching.database import DatabaseClip, MatchingDatabase


def without_sources(database: MatchingDatabase, sources: Collection[str]) -> MatchingDatabase:
    """Return the database without the clips of these sources.

    Raises `MotionError` if a source is unknown, or no clip is left.
    """
    removed = rows_of_sources(database.clips, sources)
    return _gathered(database, [clip for clip in database.clips if not removed[clip.start]], ~removed)


def without_rows(database: MatchingDatabase, removed: Flags) -> MatchingDatabase:
    """Return the database without these rows (N,); the remaining parts of a clip become clips.

    The uid of a part of a clip contains the uid of the clip and the frames, such as "walk#120-480". Searches cannot
    choose the last row of a part, since no row follows.
    """
    selectable = database.selectable.copy()
    pieces = []
    for clip in database.clips:
        kept = np.flatnonzero(~removed[clip.start : clip.stop])
        if len(kept) == clip.frame_count:
            pieces.append(clip)
            continue
        for run in np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1) if len(kept) else ():
            first, stop = int(run[0]), int(run[-1]) + 1
            name = f"#{first}-{stop}"
            piece = replace(clip, start=clip.start + first, stop=clip.start + stop, loop=False)
            pieces.append(replace(piece, uid=clip.uid + name, name=clip.name + name))
            selectable[clip.start + stop - 1] = False
    return _gathered(replace(database, selectable=selectable), pieces, ~removed)


def _gathered(database: MatchingDatabase, clips: Sequence[DatabaseClip], kept: Flags) -> MatchingDatabase:
    """Return a database with only `clips`; `kept` (N,) marks the rows of these clips in the given database."""
    if not clips:
        raise MotionError("no clip is left", code="no-clips")
    before = np.concatenate(([0], np.cumsum(kept)))
    return replace(
        database,
        clips=tuple(replace(clip, start=int(before[clip.start]), stop=int(before[clip.stop])) for clip in clips),
        **{name: rows[kept] for name, rows in _by_row(database).items()},
    )


def _by_row(database: MatchingDatabase) -> dict[str, Any]:
    """Return the arrays that have one entry per row."""
    values = {field.name: getattr(database, field.name) for field in fields(database)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
