"""Features of much motion for searches by example: real takes, and copies with other poses, speeds and sizes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.material import real_folder
from marey_motion.errors import MotionError
from marey_motion.formats import read_motion
from marey_motion.gait import generate_dataset
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_motion.similarity.features import ROTATED_JOINTS, ROTATIONS_AT, VECTORS, PoseFeatures, Rows, clip_features

_REAL_TAKES = ("bandai-namco-1/*.bvh", "bandai-namco-2/*.bvh", "cmu-bvh/*.bvh", "cmu-iclone-bvh/*.bvh")
_LEAST_ROWS = 12
_SPEEDS, _SIZES = (0.7, 1.4), (0.85, 1.2)
_MOVED_M, _TURNED_RAD, _PERIOD_ROWS = 0.02, 0.05, 45
"""Size of the changes of a copy's poses (metres, radians), and their period in rows: 45 rows are 1.5 s.

Each joint gets a constant change, and a smooth change of the same size with a new random value in each period.
"""


def takes() -> list[PoseFeatures]:
    """Return the features of each real take with a mapped skeleton, or else of generated gaits."""
    folder, found = real_folder(), []
    if folder is None:
        clips = [take.clip for take in generate_dataset()]
    else:
        files = sorted(file for pattern in _REAL_TAKES for file in folder.glob(pattern))
        clips = [clip for file in files if (clip := read_motion(file.read_bytes(), file.name).clip) is not None]
    for clip in clips:
        try:
            body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
            features = clip_features(Motion.of(clip), body, clip.frame_rate_hz)
        except MotionError:  # a skeleton without legs, or a clip without a heading
            continue
        if len(features.rows) >= _LEAST_ROWS:
            found.append(features)
    return found


def with_copies(originals: list[PoseFeatures], count: int, seed: int = 0) -> Iterator[PoseFeatures]:
    """Yield the takes, then changed copies of them, until there are at least `count` poses."""
    rng = np.random.default_rng(seed)
    poses, made = 0, 0
    while poses < count:
        original = originals[made % len(originals)]
        features = original if made < len(originals) else _changed(original, rng)
        poses, made = poses + len(features.rows), made + 1
        yield features


def _changed(features: PoseFeatures, rng: np.random.Generator) -> PoseFeatures:
    """Change speed, size and poses of a take."""
    speed, size = rng.uniform(*_SPEEDS), rng.uniform(*_SIZES)
    times = np.arange(0.0, len(features.rows) - 1, speed)
    rows = _interpolated(features.rows, times)
    count = len(rows)
    vectors = rows[:, :ROTATIONS_AT].reshape(count, 2, VECTORS // 2, 3)
    vectors *= np.float32(size)
    vectors[:, 1] *= np.float32(speed)
    moved = _drift(count, (VECTORS // 2, 3), _MOVED_M, rng) * features.present[:, None]
    vectors[:, 0] += moved
    vectors[:, 1] += np.gradient(moved, axis=0) * np.float32(30.0) if count > 1 else 0.0
    turns = rows[:, ROTATIONS_AT:].reshape(count, len(ROTATED_JOINTS), 4)
    half = _drift(count, (len(ROTATED_JOINTS), 3), _TURNED_RAD / 2, rng)
    turns[:] = _multiplied(turns, half)
    return PoseFeatures(rows, features.present)


def _interpolated(rows: Rows, times: np.ndarray) -> Rows:
    """Interpolate rows (n, WIDTH) at fractional times (m,); neighbouring rotations get the same sign first."""
    first = times.astype(np.int64)
    share = (times - first).astype(np.float32)[:, None]
    one, other = rows[first].copy(), rows[np.minimum(first + 1, len(rows) - 1)].copy()
    turns, next_turns = (each[:, ROTATIONS_AT:].reshape(len(times), -1, 4) for each in (one, other))
    next_turns *= np.where(np.sum(turns * next_turns, axis=2, keepdims=True) < 0.0, np.float32(-1.0), np.float32(1.0))
    mixed = one * (np.float32(1.0) - share) + other * share
    turns = mixed[:, ROTATIONS_AT:].reshape(len(times), -1, 4)
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    return np.ascontiguousarray(mixed, np.float32)


def _drift(count: int, shape: tuple[int, ...], size: float, rng: np.random.Generator) -> Rows:
    """Return random constants plus smooth random changes (count, *shape)."""
    knots = rng.normal(scale=size, size=(count // _PERIOD_ROWS + 3, *shape)) + rng.normal(scale=size, size=shape)
    places = np.arange(count) / _PERIOD_ROWS
    first = places.astype(np.int64)
    share = (0.5 - 0.5 * np.cos(np.pi * (places - first))).reshape(-1, *([1] * len(shape)))
    return np.asarray(knots[first] * (1.0 - share) + knots[first + 1] * share, np.float32)


def _multiplied(turns: Rows, half: Rows) -> Rows:
    """Turn unit quaternions (n, J, 4) by small rotation vectors, given as halves (n, J, 3)."""
    w, v = turns[..., :1], turns[..., 1:]
    scalar = w - np.sum(half * v, axis=-1, keepdims=True)
    vector = v + half * w + np.cross(half, v)
    turned = np.concatenate([scalar, vector], axis=-1)
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True), np.float32)
