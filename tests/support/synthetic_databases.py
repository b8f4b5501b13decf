"""Motion matching databases with known exact results: root paths are exact, and poses are sums of a few sines."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags, Floats
from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.gait import studio_skeleton
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.controller import run_trial
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.matching.search import SearchIndex, build_index
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions

FOLLOWS = ("time", "path", "open_loop")
EXACT = ControllerOptions(root_inertialisation=False, reselect_window_s=0.0)
"""Options without blending, so that the root moves exactly as in the rows."""

HORIZONS = (20, 40, 60)
POSE_DIMENSIONS = 15
NOT_SELECTABLE = 20


class Track(NamedTuple):
    """Path of a root, and the gait with which it moves."""

    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    pose: NDArray[np.float64]
    loop: bool = False
    uid: str = ""


@lru_cache
def studio_body() -> MatchingBody:
    skeleton = studio_skeleton()
    return MatchingBody.from_mapping(skeleton, map_joints(skeleton))


def gait_pose(frames: int, speed_m_s: float, phase: float = 0.0) -> NDArray[np.float64]:
    """Return pose features (frames, 15) that repeat with the stride and grow with the speed."""
    angle = 2 * np.pi * (0.8 + 0.25 * speed_m_s) * np.arange(frames) / 60 + phase
    amplitude = 0.1 + 0.1 * speed_m_s
    return np.stack([amplitude * np.sin(angle + 0.7 * d) for d in range(POSE_DIMENSIONS)], axis=1)


def arc_track(speed_m_s: float, turn_rate_deg_s: float, seconds: float, phase: float = 0.0, **options: Any) -> Track:
    """Return a root that moves on a straight line or a circle from its first frame on."""
    trial = Trial("circle", speed_m_s, float(np.radians(turn_rate_deg_s)), approach_s=0.0, duration_s=seconds)
    path = reference(trial, look_ahead_s=0.0)
    return Track(path.positions, path.headings, gait_pose(path.tick_count, speed_m_s, phase), **options)


def path_track(trial: Trial, **options: Any) -> Track:
    """Return a root that follows the path of a trial and continues for one second, because the last rows look ahead."""
    path = reference(trial)
    return Track(path.positions, path.headings, gait_pose(len(path.headings), trial.speed_m_s), **options)


def random_tracks(count: int, seed: int) -> list[Track]:
    """Return roots on random paths: asymmetric, of different lengths, each with another gait."""
    rng = np.random.default_rng(seed)
    tracks = []
    for _ in range(count):
        frames = int(rng.integers(150, 400))
        seconds = np.arange(frames) / 60
        speed = 2.0 + rng.uniform(-1, 1) + 0.5 * np.sin(2 * np.pi * rng.uniform(0.1, 0.5) * seconds + rng.uniform(0, 6))
        turn_rate = rng.uniform(-1.5, 1.5) + rng.uniform(0, 0.8) * np.sin(seconds + rng.uniform(0, 6))
        headings = np.cumsum(turn_rate) / 60 + rng.uniform(0, 6)
        steps = speed[:, None] * np.stack((np.sin(headings), np.cos(headings)), axis=1) / 60
        pose = gait_pose(frames, float(speed.mean()), rng.uniform(0, 6)) + 0.02 * rng.standard_normal((frames, 15))
        tracks.append(Track(np.cumsum(steps, axis=0) + rng.uniform(-5, 5, 2), headings, pose))
    return tracks


def mirrored_track(track: Track) -> Track:
    """Return a track reflected in x.

    The first half of the dimensions of the pose is the left side, the second half is the right side.
    """
    mirror = np.array([-1.0, 1.0])
    left, right, middle = track.pose[:, :6], track.pose[:, 6:12], track.pose[:, 12:]
    signs = np.array([-1.0, 1.0, 1.0])
    pose = np.concatenate((right * np.tile(signs, 2), left * np.tile(signs, 2), middle * signs), axis=1)
    return track._replace(positions=track.positions * mirror, headings=-track.headings, pose=pose)


def synthetic_database(
    tracks: Sequence[Track],
    options: DatabaseOptions | None = None,
    *,
    normaliser: Normaliser | None = None,
) -> MatchingDatabase:
    """Return a database of the tracks, in this order; trajectories ahead stop at the last frame, or follow a loop."""
    options = options or DatabaseOptions()
    features: list[Floats] = []
    selectable: list[Flags] = []
    clips: list[DatabaseClip] = []
    for number, track in enumerate(tracks):
        wraps = track.loop and options.end_policy == "loop"
        features.append(_features(track, wraps))
        chosen = np.ones(len(track.headings), dtype=bool)
        if not wraps:
            chosen[-NOT_SELECTABLE:] = False
        selectable.append(chosen)
        start = clips[-1].stop if clips else 0
        uid = track.uid or f"clip_{number:03d}"
        clips.append(DatabaseClip(uid, uid, "", start, start + len(chosen), loop=track.loop))
    stacked = np.concatenate(features)
    count = len(stacked)
    body = studio_body()
    rest = np.concatenate((body.skeleton.offsets[0], body.skeleton.rest_rotations.reshape(-1)))
    pose = np.concatenate([track.pose for track in tracks])
    return MatchingDatabase(
        body=body,
        clips=tuple(clips),
        options=options,
        features=stacked,
        normaliser=normaliser or fitted(stacked),
        selectable=np.concatenate(selectable),
        root_positions=np.concatenate([track.positions for track in tracks]),
        root_headings=np.concatenate([track.headings for track in tracks]),
        pose_points=_points(pose, len(body.pose_joints)),
        poses=np.tile(rest.astype(np.float32), (count, 1)),
        contacts=np.zeros((count, 2), dtype=bool),
    )


def index_of(database: MatchingDatabase) -> SearchIndex:
    """Return the search index of the normalised rows of a database."""
    normalised = (database.features - database.normaliser.offset) / database.normaliser.scale
    return build_index(normalised, database.starts, database.selectable)


def fitted(features: NDArray[np.float64]) -> Normaliser:
    """Return a normaliser without weights: means, and one scale per group, computed from their definitions."""
    spread = features.std(axis=0)
    groups = ((0, 15), (15, 21), (21, 27))
    scale = np.concatenate([np.full(stop - start, max(spread[start:stop].mean(), 1e-3)) for start, stop in groups])
    return Normaliser(features.mean(axis=0), scale, "sha256:made")


def _points(pose: NDArray[np.float64], joints: int) -> NDArray[np.float32]:
    return pose[:, np.arange(3 * joints) % POSE_DIMENSIONS].reshape(len(pose), joints, 3).astype(np.float32)


def _features(track: Track, wraps: bool) -> NDArray[np.float64]:
    frames = len(track.headings)
    positions, headings = track.positions, track.headings
    if wraps:
        positions, headings = _unwound(track)
    columns = [track.pose]
    sine, cosine = np.sin(track.headings), np.cos(track.headings)
    ahead = [np.minimum(np.arange(frames) + horizon, len(headings) - 1) for horizon in HORIZONS]
    for rows in ahead:
        x, z = (positions[rows] - track.positions).T
        columns.append(np.stack((x * cosine - z * sine, x * sine + z * cosine), axis=1))
    for rows in ahead:
        turn = headings[rows] - track.headings
        columns.append(np.stack((np.sin(turn), np.cos(turn)), axis=1))
    return np.concatenate(columns, axis=1)


def _unwound(track: Track) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return headings and positions of a loop that continues past its end, as far as features look ahead.

    The step from the last frame to the first frame is the mean of the last step and the first step.
    """
    heading, position = track.headings, track.positions

    def local(step: int) -> tuple[NDArray[np.float64], float]:
        angle = heading[step]
        x, z = position[step + 1] - position[step]
        turn = heading[step + 1] - heading[step]
        return np.array([x * np.cos(angle) - z * np.sin(angle), x * np.sin(angle) + z * np.cos(angle)]), turn

    steps = [local(step) for step in range(len(heading) - 1)]
    steps.append(((steps[-1][0] + steps[0][0]) / 2, (steps[-1][1] + steps[0][1]) / 2))
    places, headings = [position[0]], [heading[0]]
    for frame in range(len(heading) + HORIZONS[-1]):
        (left, forward), turn = steps[frame % len(steps)]
        angle = headings[-1]
        shift = np.array(
            [left * np.cos(angle) + forward * np.sin(angle), forward * np.cos(angle) - left * np.sin(angle)]
        )
        places.append(places[-1] + shift)
        headings.append(headings[-1] + turn)
    return np.array(places), np.array(headings)


def circle(speed: float, turn_rate_deg: float, **options: Any) -> Trial:
    return Trial("circle", speed, float(np.radians(turn_rate_deg)), **options)


def play(database: MatchingDatabase, trial: Trial | Reference, options: ControllerOptions = EXACT) -> TrialRecord:
    path = reference(trial) if isinstance(trial, Trial) else trial
    return run_trial(database, index_of(database), path, options)


def offsets(record: TrialRecord, trial: Trial) -> np.ndarray:
    return np.linalg.norm(record.positions - reference(trial).positions[: len(record.rows)], axis=1)


def switches(record: TrialRecord) -> int:
    return int(np.count_nonzero(record.status == Status.REPLACING))


def on_the_circle(record: TrialRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds in m/s and turn rates in deg/s without the first three seconds, the straight approach."""
    speed = np.linalg.norm(np.diff(record.positions, axis=0), axis=1) * 60
    turn_rate = np.degrees(np.diff(record.headings)) * 60
    return speed[180:], turn_rate[180:]


def database_clips(database: MatchingDatabase, rows: np.ndarray) -> np.ndarray:
    return np.searchsorted(database.starts, rows, side="right") - 1
