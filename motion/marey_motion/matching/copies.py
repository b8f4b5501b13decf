"""Copies among the clips of a database, and the search index that leaves them out.

A search may not choose frames next to the displayed one. If it found the same frames in a copy of the clip, it would
choose them there. So a second copy of a clip would change the motion, although it adds nothing to the set. Therefore,
of several clips with equal rows, only the clip with the lowest uid is searched.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.matching.search import SearchIndex, build_index


def index_of(database: MatchingDatabase) -> SearchIndex:
    """Index the normalised features of a database for search.

    Parameters
    ----------
    database : MatchingDatabase    N rows

    Returns
    -------
    SearchIndex    index of the rows that `searchable` marks

    Raises
    ------
    MotionError    if no row can be chosen
    """
    return build_index(database.normaliser.apply(database.features), database.starts, searchable(database))


def searchable(database: MatchingDatabase, removed: Flags | None = None) -> Flags:
    """Mark the rows that a search may choose.

    Clips of which all rows were removed are ignored. Of several other clips with equal rows, only the clip with the
    lowest uid is searched.

    Parameters
    ----------
    database : MatchingDatabase    N rows of C clips
    removed : (N,) bool, optional    True for rows that were removed from the set; none by default

    Returns
    -------
    (N,) bool    True for rows that a search may choose
    """
    allowed = database.selectable if removed is None else database.selectable & ~removed
    starts, groups = database.starts, equal_clips(database)
    if len(np.unique(groups)) == len(groups):
        return allowed
    gone = np.zeros(len(groups), bool) if removed is None else np.logical_and.reduceat(removed, starts[:-1])
    firsts = np.full(len(groups), len(groups))
    np.minimum.at(firsts, groups[~gone], np.flatnonzero(~gone))
    own: Flags = firsts[groups] == np.arange(len(groups))
    return allowed & np.repeat(own, np.diff(starts))


def equal_clips(database: MatchingDatabase) -> NDArray[np.int64]:
    """Find the clips whose rows are equal to the last bit.

    Parameters
    ----------
    database : MatchingDatabase    C clips

    Returns
    -------
    (C,) int64    for each clip, the index of the first clip with the same rows, which can be the clip itself
    """
    features: dict[bytes, list[int]] = {}
    found = np.arange(len(database.clips))
    for number, clip in enumerate(database.clips):
        rows = np.ascontiguousarray(database.features[clip.start : clip.stop])
        alike = features.setdefault(hashlib.sha256(rows.data).digest(), [])
        for other in alike:
            if _same_rows(database, database.clips[other], clip):
                found[number] = other
                break
        else:
            alike.append(number)
    return found


def _same_rows(database: MatchingDatabase, first: DatabaseClip, second: DatabaseClip) -> bool:
    """Check whether two clips have equal rows, and are both loops or both not.

    Rows are equal if their features, selectability, root motion, poses, contacts and translations are equal.
    """
    one, other = (slice(clip.start, clip.stop) for clip in (first, second))
    arrays = (
        database.features,
        database.selectable,
        database.root_positions,
        database.root_headings,
        database.poses,
        database.contacts,
        database.translations,
    )
    return first.loop == second.loop and all(
        np.array_equal(array[one], array[other]) for array in arrays if array is not None
    )
