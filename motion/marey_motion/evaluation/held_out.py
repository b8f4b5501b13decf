"""Trials along the paths of real takes: the path of a clip is the desired path, and the clip is left out of the set.

A person walked such a path, so if the set cannot follow it, the set lacks data. Clips without a path, such as those of
standing people, have no trial; of a long clip, only the beginning is used.

The poses of the clip are the ground truth with which the displayed poses are compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.arrays import Flags, Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.selection import rows_of_sources, source_of
from marey_motion.evaluation.scenario import KEY_RATE_HZ, LOOK_AHEAD_S, Trial, require_names
from marey_motion.matching.copies import equal_clips
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.matching.display import displayed_points
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex, build_index
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import ControllerOptions

LEAST_S = 3.0
"""Shortest part of a clip that can be a desired path, in seconds; a second more is needed for the look-ahead."""
LEAST_PATH_M = 2.0
"""Shortest path of a clip, in metres, that can be a desired path."""
PHASE_S = 0.5
"""Seconds by which a displayed pose may be earlier or later than the pose of the take with which it is compared.

This is about half a stride: the character can make the same steps as the take, but with the other foot first.
"""
MOST_NAME = 80
"""Longest name of a clip in the name of a trial; longer names are replaced by the uid."""


def take_trials(database: MatchingDatabase, options: EvaluationOptions) -> tuple[Trial, ...]:
    """List trials along the paths of clips of a set, in the order of the clips.

    Parameters
    ----------
    database : MatchingDatabase    the set
    options : EvaluationOptions    families of trials, and greatest number and duration of trials along takes

    Returns
    -------
    tuple of Trial    at most `options.most_takes`, evenly distributed over the clips; empty if `options.families` lacks
        the family "takes"

    Raises
    ------
    MotionError    if no clip is long enough and travels far enough (clips of walking in place do not count), or if the
        set does not contain two different clips
    """
    if "takes" not in options.families:
        return ()
    plain = np.array([clip.mirrored_from is None for clip in database.clips])
    asked = plain if plain.any() else ~plain  # all clips are mirrored copies if only these are in the set
    sources = [clip for clip, wanted in zip(database.clips, asked, strict=True) if wanted]
    found = [(clip, path) for clip in sources if (path := _path_of(database, clip, options.duration_s)) is not None]
    if not found or len(np.unique(equal_clips(database)[asked])) < 2:
        raise MotionError(
            f"trials along takes need two different clips, one of which lasts at least {LEAST_S + LOOK_AHEAD_S:g} s "
            f"and travels at least {LEAST_PATH_M:g} m (not walking in place); add such clips, or leave out the family "
            "takes",
            code="no-takes",
        )
    chosen = np.unique(np.linspace(0, len(found) - 1, min(options.most_takes, len(found))).round().astype(int))
    names = [clip.name for clip, _ in found]
    trials = tuple(_trial(clip, path, options, names) for clip, path in (found[number] for number in chosen))
    require_names(trials)
    return trials


def _trial(clip: DatabaseClip, path: Floats, options: EvaluationOptions, names: Sequence[str]) -> Trial:
    seconds = (len(path) - 1) / KEY_RATE_HZ - LOOK_AHEAD_S
    length_m = _length_m(path[: round(seconds * KEY_RATE_HZ) + 1])
    named = names.count(clip.name) == 1 and len(clip.name) <= MOST_NAME
    return Trial(
        family="takes",
        speed_m_s=length_m / seconds,
        turn_rate_rad_s=0.0,
        approach_s=options.approach_s,
        duration_s=seconds,
        left_out=source_of(clip),
        label=clip.name if named else clip.uid,
        path=tuple((x, z, heading) for x, z, heading in path.tolist()),
    )


def _path_of(database: MatchingDatabase, clip: DatabaseClip, longest_s: float) -> Floats | None:
    """Return the beginning of a clip's path as keys of x, z and heading (K, 3), in metres and radians.

    The path starts at the origin with the heading 0. Returns None if the clip is too short, travels too little, or
    shows walking in place.
    """
    rate_hz, rows = database.options.rate_hz, slice(clip.start, clip.stop)
    seconds = min(longest_s, (clip.frame_count - 1) / rate_hz - LOOK_AHEAD_S)
    count = int((seconds + LOOK_AHEAD_S) * KEY_RATE_HZ + 1e-9) + 1
    if seconds < LEAST_S or clip.in_place:
        return None
    frames = np.arange(clip.frame_count) / rate_hz
    keys = np.arange(count) / KEY_RATE_HZ
    x, z, heading = (
        np.interp(keys, frames, values) for values in (*database.root_positions[rows].T, database.root_headings[rows])
    )
    sine, cosine = np.sin(heading[0]), np.cos(heading[0])
    x, z = x - x[0], z - z[0]
    path = np.stack((x * cosine - z * sine, x * sine + z * cosine, heading - heading[0]), axis=1)
    return path if _length_m(path) >= LEAST_PATH_M else None


def _length_m(path: Floats) -> float:
    return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())


def index_for(database: MatchingDatabase, index: SearchIndex, trial: Trial) -> SearchIndex:
    """Return the search index of a trial: without the clip whose path is followed, its mirrored copy and equal clips.

    Parameters
    ----------
    database : MatchingDatabase    the set
    index : SearchIndex    index of the rows that other trials search
    trial : Trial    the trial

    Returns
    -------
    SearchIndex    the index; `index` itself if the trial is not along the path of a clip

    Raises
    ------
    MotionError    if no row is left to choose
    """
    if not trial.left_out:
        return index
    allowed = index.selectable & ~_rows_of_take(database, trial.left_out)
    return build_index(index.rows, database.starts, allowed, method="boxes" if index.boxed else "scan")


def pose_errors(
    database: MatchingDatabase, options: ControllerOptions, trial: Trial, record: TrialRecord, window: Flags
) -> dict[str, float | None]:
    """Compare the displayed poses of a trial along a take with the poses of the take.

    The error of a pose is the mean distance of its joints from those of the take, each in the frame of its own root.
    The joints are those of the pose cost.

    Parameters
    ----------
    database : MatchingDatabase    the set
    options : ControllerOptions    options of the trial
    trial : Trial    the trial
    record : TrialRecord    T simulated ticks of the trial
    window : (T - 1,) bool    the steps that count; step k leads from tick k to tick k + 1

    Returns
    -------
    dict of str to float or None    metres: `pose_error_mean` and `pose_error_p95`, compared with the pose of the take
        at the same time; and `pose_error_nearest`, the mean of the errors compared with the nearest pose of the take at
        most `PHASE_S` earlier or later. The dict is empty if the trial is not along a take; its values are None if no
        step counts
    """
    if not trial.left_out:
        return {}
    start = round(trial.approach_s * record.rate_hz)
    ticks = np.flatnonzero(np.append(False, window))
    ticks = ticks[ticks >= start]
    if not len(ticks):
        return dict.fromkeys(("pose_error_mean", "pose_error_p95", "pose_error_nearest"))
    shown = displayed_points(database, record.rows, database.body.pose_chain, options)[ticks]
    take = _take_of(database, trial.left_out)
    truth = database.pose_points[take.start : take.stop].astype(np.float64)

    def errors(shift: int) -> Floats:
        frames = np.clip(ticks - start + shift, 0, len(truth) - 1)
        return np.asarray(np.linalg.norm(shown - truth[frames], axis=-1).mean(axis=-1))

    own = nearest = errors(0)
    most = round(PHASE_S * record.rate_hz)
    for shift in range(-most, most + 1):
        nearest = np.minimum(nearest, errors(shift))
    return {
        "pose_error_mean": float(own.mean()),
        "pose_error_p95": float(np.percentile(own, 95.0)),
        "pose_error_nearest": float(nearest.mean()),
    }


def _take_of(database: MatchingDatabase, source: str) -> DatabaseClip:
    """Return the clip of a source; its mirrored copy only if the set contains nothing else of it."""
    own = [clip for clip in database.clips if source_of(clip) == source]
    return min(own, key=lambda clip: clip.mirrored_from is not None)


def _rows_of_take(database: MatchingDatabase, source: str) -> Flags:
    """Mark the rows (N,) of a source clip, of its mirrored copy, and of all clips that equal one of them."""
    own = rows_of_sources(database.clips, [source])
    groups = equal_clips(database)
    return np.isin(groups, groups[own[database.starts[:-1]]])[database.clip_of_row]
