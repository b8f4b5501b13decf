"""Matching databases made from others: parts with fewer clips or fewer frames, and two databases joined.

Features and normaliser are not computed again but copied. A clip and its mirrored copy are selected together, by the
uid of the source.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from marey_motion.arrays import Flags
from marey_motion.errors import MotionError
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.skeleton import SAME_OFFSET_M, same_hierarchy


def source_of(clip: DatabaseClip) -> str:
    """Return the uid of a clip's source, which is the clip itself or, for a mirrored copy, the clip that was mirrored.

    Parameters
    ----------
    clip : DatabaseClip    a clip or a mirrored copy

    Returns
    -------
    str    uid of the source
    """
    return clip.mirrored_from or clip.uid


def clips_by_source(clips: Sequence[DatabaseClip]) -> dict[str, tuple[int, ...]]:
    """Group clips by source: a clip and its mirrored copy have the same source.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips

    Returns
    -------
    dict of str to tuple of int    indices of the one or two clips of each source, in the order of the uids
    """
    families: dict[str, list[int]] = {}
    for index, clip in enumerate(clips):
        families.setdefault(source_of(clip), []).append(index)
    return {source: tuple(own) for source, own in sorted(families.items())}


def require_sources(known: Collection[str], wanted: Collection[str]) -> None:
    """Check that source clips exist.

    Parameters
    ----------
    known, wanted : collection of str    uids

    Raises
    ------
    MotionError    if a wanted source is not known; the error names the first unknown source
    """
    unknown = sorted(set(wanted) - set(known))
    if unknown:
        raise MotionError(f"the database has no clip {unknown[0]}", code="unknown-clip", where=unknown[0])


def rows_of_sources(clips: Sequence[DatabaseClip], sources: Collection[str]) -> Flags:
    """Mark the rows of some source clips and their mirrored copies.

    Parameters
    ----------
    clips : sequence of DatabaseClip    clips of N rows
    sources : collection of str    uids

    Returns
    -------
    (N,) bool    True for the rows of these sources

    Raises
    ------
    MotionError    if a source has no clip
    """
    require_sources({source_of(clip) for clip in clips}, sources)
    rows = np.zeros(clips[-1].stop if clips else 0, dtype=np.bool_)
    for clip in clips:
        if source_of(clip) in sources:
            rows[clip.start : clip.stop] = True
    return rows


def _by_row(database: MatchingDatabase) -> dict[str, Any]:
    """Return the arrays of a database that have one entry per row, by field name."""
    values = {field.name: getattr(database, field.name) for field in fields(database)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def without_sources(database: MatchingDatabase, sources: Collection[str]) -> MatchingDatabase:
    """Return a database without the clips of some sources.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    sources : collection of str    uids

    Returns
    -------
    MatchingDatabase    the other clips, with the same features and normaliser

    Raises
    ------
    MotionError    if a source is unknown, or no clip is left
    """
    removed = rows_of_sources(database.clips, sources)
    return _gathered(database, [clip for clip in database.clips if not removed[clip.start]], ~removed)


def without_rows(database: MatchingDatabase, removed: Flags) -> MatchingDatabase:
    """Return a database without some rows; the remaining parts of a clip become clips.

    The uid of a part of a clip contains the uid of the clip and the frames, such as "walk#120-480". Searches cannot
    choose the last row of a part, since no row follows.

    Parameters
    ----------
    database : MatchingDatabase    N rows
    removed : (N,) bool    True for rows to leave out

    Returns
    -------
    MatchingDatabase    the other rows, with the same features and normaliser

    Raises
    ------
    MotionError    if no clip is left
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
        raise MotionError("no clip is left in the database; keep at least one clip", code="no-clips")
    before = np.concatenate(([0], np.cumsum(kept)))
    return replace(
        database,
        clips=tuple(replace(clip, start=int(before[clip.start]), stop=int(before[clip.stop])) for clip in clips),
        **{name: rows[kept] for name, rows in _by_row(database).items()},
    )


def joined(first: MatchingDatabase, second: MatchingDatabase) -> MatchingDatabase:
    """Join two databases with the same skeleton and options; the result has the normaliser of the first database.

    Parameters
    ----------
    first, second : MatchingDatabase    the databases

    Returns
    -------
    MatchingDatabase    the clips of both databases

    Raises
    ------
    MotionError    if skeletons or options differ, or both databases have the same clip
    """
    if first.options != second.options:
        raise MotionError(
            "the two databases were built with different options; build both with the same options", where="options"
        )
    require_same_skeleton(first, second)
    shared = sorted({clip.uid for clip in first.clips} & {clip.uid for clip in second.clips})
    if shared:
        raise MotionError(f"both databases contain the clip {shared[0]}; remove it from one of them", where=shared[0])
    origins = [(clip, 0) for clip in first.clips] + [(clip, first.row_count) for clip in second.clips]
    clips, rows, start = [], [], 0
    for clip, offset in sorted(origins, key=lambda origin: origin[0].uid):
        rows.append(np.arange(clip.start, clip.stop) + offset)
        clips.append(replace(clip, start=start, stop=start + clip.frame_count))
        start += clip.frame_count
    order = np.concatenate(rows)
    joints = tuple(sorted({*first.translated_joints, *second.translated_joints}))
    first, second = _translating(first, joints), _translating(second, joints)
    arrays: dict[str, Any] = {
        name: np.concatenate((rows, getattr(second, name)))[order] for name, rows in _by_row(first).items()
    }
    return replace(first, clips=tuple(clips), notes=tuple(dict.fromkeys((*first.notes, *second.notes))), **arrays)


def _translating(database: MatchingDatabase, joints: tuple[int, ...]) -> MatchingDatabase:
    """Store local translations of exactly `joints`; joints without stored translations get their offsets."""
    if joints == database.translated_joints:
        return database
    translations = np.empty((database.row_count, len(joints), 3), np.float32)
    translations[:] = database.body.skeleton.offsets[list(joints)]
    if database.translations is not None:
        translations[:, np.searchsorted(joints, database.translated_joints)] = database.translations
    return replace(database, translations=translations, translated_joints=joints)


def same_skeleton(first: MatchingDatabase, second: MatchingDatabase) -> bool:
    """Check whether clips of two databases can be in one database.

    The end sites of the skeletons may differ, and so may the offsets of joints that are translated in both databases.
    To make the skeletons equal, build one database with the body of the other (`build_database`).

    Parameters
    ----------
    first, second : MatchingDatabase    the databases

    Returns
    -------
    bool    True if clips of both databases can be mixed
    """
    one, other = first.body.skeleton, second.body.skeleton
    if first.body.pose_joints != second.body.pose_joints or one.joint_count != other.joint_count:
        return False
    offsets, replaced = other.offsets.copy(), [0, *({*first.translated_joints} & {*second.translated_joints})]
    offsets[replaced] = one.offsets[replaced]
    alike = replace(other, offsets=offsets, end_sites=one.end_sites)
    return same_hierarchy(one, alike, tolerance_m=SAME_OFFSET_M)


def require_same_skeleton(first: MatchingDatabase, second: MatchingDatabase) -> None:
    """Check that two databases have the same skeleton, so that their clips can be in one database.

    Parameters
    ----------
    first, second : MatchingDatabase    the databases

    Raises
    ------
    MotionError    if the skeletons differ
    """
    if not same_skeleton(first, second):
        raise MotionError(
            "the clips to add have another skeleton than the database; retarget them to the database's skeleton first",
            code="skeleton-mismatch",
            where="skeleton",
        )
