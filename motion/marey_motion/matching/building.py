"""Construction of a matching database from clips."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.importing.landmarks import find_landmarks
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.database import DatabaseClip, DatabaseNote, MatchingDatabase, SourceClip
from marey_motion.matching.features import FeatureLayout, feature_layout
from marey_motion.matching.normaliser import Normaliser, fit_normaliser
from marey_motion.matching.preparing import PreparedClip, mirror_prepared, prepare_clip
from marey_motion.matching.rows import ClipRows, clip_rows
from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.options.matching import DatabaseOptions
from marey_schemas.wording import counted

MOST_MATCHED_JOINTS = 5

Progress = Callable[[int, int, str], None]
_Built = tuple[DatabaseClip, ClipRows, tuple[DatabaseNote, ...]]


def build_database(
    clips: Sequence[SourceClip],
    body: MatchingBody,
    options: DatabaseOptions = DatabaseOptions(),  # noqa: B008 - frozen
    *,
    normaliser: Normaliser | None = None,
    progress: Progress | None = None,
) -> MatchingDatabase:
    """Build a matching database from clips of one skeleton; the result does not depend on the order of the clips.

    Parameters
    ----------
    clips : sequence of SourceClip    clips of the body's skeleton
    body : MatchingBody    the joints to match
    options : DatabaseOptions    rate, horizons and weights
    normaliser : Normaliser, optional    a normaliser that was fitted earlier; its weights replace those of `options`.
        If None, a normaliser is fitted to these clips
    progress : callable, optional    called as progress(clips done, total, name of the last clip)

    Returns
    -------
    MatchingDatabase    features, root motion and poses

    Raises
    ------
    MotionError    if no clip is given; if a clip has another skeleton, has no facing direction or lacks the selected
        frames (the error names the clip); if two clips have the same uid; if the body lacks a joint that the options
        select; or if the normaliser has other feature dimensions

    Notes
    -----
    A clip that is too short to look ahead is no error: none of its rows can be chosen, and a note says so.
    """
    layout = feature_layout(options, body)
    if normaliser is not None:
        normaliser.require_fit(layout)
    built = sorted(_built(_ordered(clips), body, layout, options, progress), key=lambda row: row[0].uid)
    entries, start = [], 0
    for entry, rows, _ in built:
        entries.append(replace(entry, start=start, stop=start + len(rows.features)))
        start = entries[-1].stop
    translations, translated_joints = _joined_translations(built, body)
    arrays = {
        name: np.concatenate([getattr(rows, name) for _, rows, _ in built])
        for name in ClipRows._fields
        if name not in ("translations", "translated_joints")
    }
    if normaliser is None:
        normaliser = fit_normaliser(arrays["features"], layout, _digest_of([arrays["features"]]))
    return MatchingDatabase(
        body=body,
        clips=tuple(entries),
        options=options,
        normaliser=normaliser,
        translations=translations,
        translated_joints=translated_joints,
        notes=(*_layout_notes(layout), *_normaliser_notes(normaliser), *(note for row in built for note in row[2])),
        **arrays,
    )


def with_normaliser(database: MatchingDatabase, normaliser: Normaliser) -> MatchingDatabase:
    """Replace the normaliser of a database.

    Parameters
    ----------
    database : MatchingDatabase    the database
    normaliser : Normaliser    the new normaliser

    Returns
    -------
    MatchingDatabase    database with the same rows and the new normaliser

    Raises
    ------
    MotionError    if the normaliser has other dimensions
    """
    normaliser.require_fit(database.layout)
    kept = [note for note in database.notes if note.code != "scale-floored"]
    return replace(database, normaliser=normaliser, notes=(*kept, *_normaliser_notes(normaliser)))


def union_normaliser(databases: Sequence[MatchingDatabase]) -> Normaliser:
    """Fit one normaliser to the rows of several databases, so that costs in different databases can be compared.

    Parameters
    ----------
    databases : sequence of MatchingDatabase    in any order

    Returns
    -------
    Normaliser    fitted to all rows

    Raises
    ------
    MotionError    if no database is given, or if the databases have different joints, horizons or weights
    """
    if not databases:
        raise MotionError("a normaliser needs at least one database, but none was given", code="no-features")
    ordered = sorted(databases, key=database_digest)
    layout = ordered[0].layout
    for other in ordered[1:]:
        same_groups = [group._replace(joint=None) for group in other.layout.groups] == [
            group._replace(joint=None) for group in layout.groups
        ]
        if other.layout.names != layout.names or not same_groups:
            raise MotionError(
                "the databases differ in joints, horizons or weights; build them with the same options",
                code="normaliser-mismatch",
            )
    features = np.concatenate([database.features for database in ordered])
    return fit_normaliser(features, layout, _digest_of([features]))


def database_digest(database: MatchingDatabase) -> str:
    """Compute a digest of all data of a database that searches and controllers use, except the normaliser.

    Parameters
    ----------
    database : MatchingDatabase    the database

    Returns
    -------
    str    "sha256:…"
    """
    clips = [(clip.uid, clip.start, clip.stop, clip.loop) for clip in database.clips]
    return _digest_of(
        [
            database.features,
            database.selectable,
            database.root_positions,
            database.root_headings,
            database.pose_points,
            database.poses,
        ],
        json.dumps([clips, database.options.end_policy]),
    )


def _digest_of(arrays: Sequence[NDArray[Any]], text: str = "") -> str:
    content = hashlib.sha256(text.encode())
    for array in arrays:
        content.update(f"{array.dtype.str} {array.shape}\n".encode())
        content.update(np.ascontiguousarray(array).data)
    return digest_of_hash(content)


def _ordered(clips: Sequence[SourceClip]) -> list[SourceClip]:
    if not clips:
        raise MotionError("a database is built from clips, but none were given", code="no-clips")
    ordered = sorted(clips, key=lambda clip: clip.uid)
    for clip, following in pairwise(ordered):
        if clip.uid == following.uid:
            raise MotionError(
                f"{clip.name} and {following.name} have the same uid {clip.uid}; give each clip a different uid",
                code="uid-repeated",
                where=clip.name,
            )
    return ordered


def _built(
    clips: Sequence[SourceClip],
    body: MatchingBody,
    layout: FeatureLayout,
    options: DatabaseOptions,
    progress: Progress | None,
) -> Iterator[_Built]:
    landmarks = find_landmarks(body.skeleton)
    for done, source in enumerate(clips, start=1):
        try:
            for clip in _variants(prepare_clip(source, body, options, landmarks), body, options):
                rows = clip_rows(clip.motion, clip.seam, body, layout, options)
                yield _entry(clip), rows, (*clip.notes, *_row_notes(clip, rows, options))
        except MotionError as error:
            where = f"{source.name}, {error.where}" if error.where else source.name
            raise MotionError(error.message, code=error.code, where=where) from error
        if progress is not None:
            progress(done, len(clips), source.name)


def _variants(clip: PreparedClip, body: MatchingBody, options: DatabaseOptions) -> Iterator[PreparedClip]:
    if options.mirroring != "only":
        yield clip
    if options.mirroring != "none":
        yield mirror_prepared(clip, body, keep_notes=options.mirroring == "only")


def _entry(clip: PreparedClip) -> DatabaseClip:
    source = clip.source
    return DatabaseClip(
        uid=clip.uid,
        name=f"{source.name} (mirrored)" if clip.mirrored else source.name,
        content=source.content,
        start=0,
        stop=clip.motion.frame_count,
        loop=source.loop,
        mirrored_from=source.uid if clip.mirrored else None,
        tags=source.tags,
        in_place=clip.in_place,
        first_s=clip.first_s,
    )


def _row_notes(clip: PreparedClip, rows: ClipRows, options: DatabaseOptions) -> tuple[DatabaseNote, ...]:
    is_said_of_original = clip.mirrored and options.mirroring != "only"
    if rows.selectable.any() or is_said_of_original:
        return ()
    length = counted(len(rows.selectable), "frame")
    message = f"{clip.source.name}: the clip has {length}, too few to look ahead, so none of its rows can be chosen"
    return (DatabaseNote("too-short", message, clip.uid),)


def _layout_notes(layout: FeatureLayout) -> tuple[DatabaseNote, ...]:
    count = len(layout.matched_joints)
    if count <= MOST_MATCHED_JOINTS:
        return ()
    message = (
        f"{count} joints are matched; with more than {MOST_MATCHED_JOINTS}, the trajectory hardly affects the search; "
        "match fewer joints, or raise the weights of the trajectory"
    )
    return (DatabaseNote("many-joints", message),)


def _normaliser_notes(normaliser: Normaliser) -> tuple[DatabaseNote, ...]:
    return tuple(
        DatabaseNote("scale-floored", f"{group} hardly varies in these clips; its scale was raised to the minimum")
        for group in normaliser.floored
    )


def _joined_translations(
    built: Sequence[_Built], body: MatchingBody
) -> tuple[NDArray[np.float32] | None, tuple[int, ...]]:
    """Collect the translations (N, k, 3) of the k joints that any clip translates, and the indices of these joints.

    For a clip that does not translate one of these joints, the joint's offset is used. Returns None and no joints if no
    clip translates a joint.
    """
    joints = np.array(sorted({joint for row in built for joint in row[1].translated_joints}), dtype=np.int64)
    if not len(joints):
        return None, ()
    joined = np.empty((sum(len(row[1].features) for row in built), len(joints), 3), np.float32)
    joined[:] = body.skeleton.offsets[joints]
    start = 0
    for _, rows, _ in built:
        stop = start + len(rows.features)
        joined[start:stop, np.searchsorted(joints, rows.translated_joints)] = rows.translations
        start = stop
    return joined, tuple(int(joint) for joint in joints)
