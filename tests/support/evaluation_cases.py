"""Small trials, records and databases with known contents, for tests of measures."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.gait import studio_skeleton
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import DatabaseOptions

RATE_HZ = 60.0


def closed_reference(trial: Trial) -> Reference:
    """Return the trial's reference path with one more tick at the end, so that the circle is complete."""
    asked = reference(trial, RATE_HZ)
    return replace(asked, tick_count=asked.tick_count + 1)


def record_of(
    asked: Reference,
    *,
    positions: NDArray[np.float64] | None = None,
    headings: NDArray[np.float64] | None = None,
    **given: Any,
) -> TrialRecord:
    """Return a record that follows the reference exactly on one clip, except for the given values."""
    ticks = asked.tick_count
    columns: dict[str, Any] = {
        "rows": np.arange(ticks, dtype=np.int32),
        "positions": asked.positions[:ticks] if positions is None else positions,
        "headings": asked.headings[:ticks] if headings is None else headings,
        "status": np.full(ticks, Status.KEPT, dtype=np.int8),
        "match_cost": np.full(ticks, np.nan),
        "continuing_cost": np.full(ticks, np.nan),
        "pose_cost": np.zeros(ticks),
    }
    return TrialRecord(rate_hz=asked.rate_hz, **(columns | given))


def straight_record(asked: Reference, speeds_m_s: NDArray[np.float64]) -> TrialRecord:
    """Return a record that moves along +z; step k has the speed `speeds_m_s[k - 1]`."""
    z = np.concatenate(([0.0], np.cumsum(speeds_m_s) / asked.rate_hz))
    return record_of(asked, positions=np.stack((np.zeros_like(z), z), axis=1), headings=np.zeros_like(z))


def walked_record(rows: Sequence[int], status: Sequence[Status] | None = None) -> TrialRecord:
    """Return a record that contains only the displayed rows and their status.

    By default, a row that does not follow the previous row counts as chosen by a search (`REPLACING`); all others are
    `KEPT`.
    """
    shown = np.array(rows, dtype=np.int32)
    jumped = np.concatenate(([False], np.diff(shown) != 1))
    chosen = np.where(jumped, Status.REPLACING, Status.KEPT) if status is None else np.array(status)
    ticks = len(shown)
    nothing = np.full(ticks, np.nan)
    return TrialRecord(
        RATE_HZ,
        shown,
        np.zeros((ticks, 2)),
        np.zeros(ticks),
        chosen.astype(np.int8),
        nothing,
        nothing,
        np.zeros(ticks),
    )


def clips_of(*frame_counts: int, loop: bool = False) -> tuple[DatabaseClip, ...]:
    """Return clips `a`, `b`, `c` and so on with these numbers of frames; their rows are consecutive."""
    stops = np.cumsum(frame_counts).tolist()
    return tuple(
        DatabaseClip(chr(97 + index), f"clip {index}", "", stop - frames, stop, loop)
        for index, (frames, stop) in enumerate(zip(frame_counts, stops, strict=True))
    )


def arc(speed_m_s: float, turn_rate_deg_s: float, duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (F, 2) and headings (F,) on a circle that begins at the origin; the last tick is included."""
    trial = Trial("circle", speed_m_s, np.radians(turn_rate_deg_s), approach_s=0.0, duration_s=duration_s)
    asked = closed_reference(trial)
    return asked.positions[: asked.tick_count], asked.headings[: asked.tick_count]


def trajectory_database(*roots: tuple[NDArray[np.float64], NDArray[np.float64]]) -> MatchingDatabase:
    """Return a database whose rows differ only in root paths.

    The future trajectory of a row stops at the clip's last frame.
    """
    database = root_database(*roots)
    ahead = np.round(np.array(database.options.horizons_s) * RATE_HZ).astype(np.int64)
    features = [np.concatenate([_futures(*root, ahead) for root in roots])]
    features.insert(0, np.zeros((database.row_count, 27 - features[0].shape[1])))
    stops = np.array([clip.stop for clip in database.clips])
    rows = np.arange(database.row_count)
    left = stops[np.searchsorted(stops, rows, side="right")] - rows
    return replace(
        database,
        features=np.concatenate(features, axis=1),
        normaliser=Normaliser(np.zeros(27), np.ones(27), ""),
        selectable=left > ahead[0],
    )


def _futures(
    positions: NDArray[np.float64], headings: NDArray[np.float64], ahead: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return (F, 12): positions at three future times, then directions. All are relative to the root of the row."""
    frames = len(headings)
    later = np.minimum(np.arange(frames)[:, None] + ahead, frames - 1)
    step = positions[later] - positions[:, None]
    sine, cosine = np.sin(headings)[:, None], np.cos(headings)[:, None]
    places = np.stack(
        (step[..., 0] * cosine - step[..., 1] * sine, step[..., 0] * sine + step[..., 1] * cosine), axis=-1
    )
    turned = headings[later] - headings[:, None]
    directions = np.stack((np.sin(turned), np.cos(turned)), axis=-1)
    return np.concatenate((places.reshape(frames, -1), directions.reshape(frames, -1)), axis=1)


def root_database(
    *roots: tuple[NDArray[np.float64], NDArray[np.float64]], options: DatabaseOptions | None = None
) -> MatchingDatabase:
    """Return a database that contains only the paths of the roots of its clips: no features, no poses."""
    clips = clips_of(*(len(headings) for _, headings in roots))
    rows = clips[-1].stop
    skeleton = studio_skeleton()
    rest = np.tile((1.0, 0.0, 0.0, 0.0), skeleton.joint_count)
    return MatchingDatabase(
        body=MatchingBody.from_mapping(skeleton, map_joints(skeleton)),
        clips=clips,
        options=options or DatabaseOptions(),
        features=np.zeros((rows, 27)),
        normaliser=Normaliser(np.zeros(27), np.ones(27), ""),
        selectable=np.full(rows, True),
        root_positions=np.concatenate([positions for positions, _ in roots]),
        root_headings=np.concatenate([headings for _, headings in roots]),
        pose_points=np.zeros((rows, 7, 3), np.float32),
        poses=np.tile(np.concatenate((np.zeros(3), rest)).astype(np.float32), (rows, 1)),
        contacts=np.full((rows, 2), True),
    )
