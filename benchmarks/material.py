"""Motion to measure with: gaits that Marey generates, and real capture if MAREY_TEST_MOCAP names a folder."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.formats import read_motion, write_bvh
from marey_motion.gait import generate_dataset, generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.features import feature_layout
from marey_motion.matching.normaliser import fit_normaliser
from marey_motion.rigs import map_joints
from marey_motion.skeleton import Skeleton

_FINGER_BONE_M = (0.0, -0.025, 0.005)
_SMALL_FILES, _SMALL_BODIES, _LEAST_JOINTS = 120, 12, 26
_REAL_LOCOMOTION = ("bandai-namco-1/*.bvh", "bandai-namco-2/*.bvh", "cmu-bvh/*.bvh")


def real_folder() -> Path | None:
    """Return the folder of real motion capture, or None if MAREY_TEST_MOCAP is not set."""
    folder = os.environ.get("MAREY_TEST_MOCAP")
    return Path(folder) if folder else None


@contextmanager
def folder_of_takes() -> Iterator[Path]:
    """Yield the folder of real motion capture, or else a temporary folder of small generated takes."""
    real = real_folder()
    if real is not None:
        yield real
        return
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        for number in range(_SMALL_FILES):
            joints = _LEAST_JOINTS + number % _SMALL_BODIES
            take = captured_walk(60 + 20 * (number % 13), joints, number)
            Path(folder, f"take-{number:03}.bvh").write_bytes(write_bvh(take))
        yield Path(folder)


def noisy_clip(frames: int, joints: int, seed: int = 0) -> Clip:
    """Return a clip of random smooth motion at 60 Hz, with capture noise of 2e-4 rad and 0.05 mm.

    Each Euler angle is the sum of five harmonics about a random constant angle.
    """
    rng = np.random.default_rng(seed)
    seconds = np.arange(frames) / 60.0
    angles = _harmonics(seconds, (joints, 3), 0.4, rng) + rng.normal(scale=0.3, size=(joints, 3))
    angles += rng.normal(scale=2e-4, size=angles.shape)
    root = _harmonics(seconds, (3,), 0.2, rng) + rng.normal(scale=5e-5, size=(frames, 3))
    root += np.stack([0.2 * seconds, np.full(frames, 0.9), 1.3 * seconds], axis=1)
    rotations = quaternions.unroll(quaternions.from_euler("zxy", angles))
    poses = np.concatenate([root, rotations.reshape(frames, 4 * joints)], axis=1).astype(np.float32)
    return Clip(chain_skeleton(joints, rng), 60.0, poses, None, ())


def _harmonics(
    seconds: NDArray[np.float64], channels: tuple[int, ...], amplitude: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    orders = np.arange(1, 6)
    phases = rng.uniform(0, 2 * np.pi, (*channels, 5))
    sizes = rng.normal(scale=amplitude, size=(*channels, 5)) / orders
    waves = np.sin(2 * np.pi * 0.3 * seconds.reshape(-1, *([1] * (len(channels) + 1))) * orders + phases)
    return np.asarray((waves * sizes).sum(axis=-1))


def chain_skeleton(joints: int, rng: np.random.Generator) -> Skeleton:
    """Return a random skeleton of `joints` joints, with limbs of about five joints."""
    parents: NDArray[np.int32] = np.array([-1, *(max(0, j - 1) if j % 5 else 0 for j in range(1, joints))], np.int32)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1))
    return Skeleton(
        tuple(f"joint{j:02d}" for j in range(joints)), parents, rng.normal(scale=0.1, size=(joints, 3)), identity
    )


def captured_walk(frames: int, joints: int, seed: int = 0, *, frame_rate_hz: float = 120.0) -> Clip:
    """Return a generated walk like one from a capture system: with fingers, and noise on every channel.

    The number of finger joints is `joints` minus the number of joints of the generated body.
    """
    walk = generate_gait(1.3, 0.2, frames / frame_rate_hz, frame_rate_hz)
    skeleton = with_fingers(walk.skeleton, joints, "LeftHand")
    rng = np.random.default_rng(seed)
    seconds = np.arange(frames) / frame_rate_hz
    fingers = _harmonics(seconds, (joints - walk.skeleton.joint_count, 3), 0.1, rng)
    curled = quaternions.from_euler("zxy", fingers)
    shaken = quaternions.from_euler("zxy", rng.normal(scale=2e-4, size=(frames, joints, 3)))
    still = np.concatenate([walk.rotations.astype(np.float64), curled], axis=1)
    rotations = quaternions.unroll(quaternions.multiply(still, shaken))
    root = walk.root_translations + rng.normal(scale=5e-5, size=(frames, 3))
    poses = np.concatenate([root, rotations.reshape(frames, 4 * joints)], axis=1).astype(np.float32)
    return Clip(skeleton, frame_rate_hz, poses)


def with_fingers(skeleton: Skeleton, joints: int, hand: str) -> Skeleton:
    """Return the skeleton with fingers of three joints added to one hand, so that it has `joints` joints."""
    old, new = skeleton.joint_count, joints - skeleton.joint_count
    names = tuple(f"{hand}Finger{index // 3 + 1}_{index % 3 + 1}" for index in range(new))
    parents = [old + index - 1 if index % 3 else skeleton.index_of(hand) for index in range(new)]
    return replace(
        skeleton,
        joint_names=skeleton.joint_names + names,
        display_names=skeleton.display_names + names,
        parents=np.concatenate([skeleton.parents, np.array(parents, np.int32)]),
        offsets=np.concatenate([skeleton.offsets, np.tile(_FINGER_BONE_M, (new, 1))]),
        rest_rotations=np.concatenate([skeleton.rest_rotations, np.tile([1.0, 0.0, 0.0, 0.0], (new, 1))]),
    )


def matching_features() -> list[NDArray[np.float64]]:
    """Return the normalised features (F, 27) of each generated take, and of each captured take if there are any."""
    databases = [_database_of(take.name, take.clip) for take in generate_dataset()]
    folder = real_folder()
    for path in sorted(file for pattern in _REAL_LOCOMOTION if folder for file in folder.glob(pattern)):
        clip = read_motion(path.read_bytes(), path.name).clip
        assert clip is not None, f"{path.name} holds no motion"
        databases.append(_database_of(path.name, clip))
    layout = feature_layout(databases[0].options, databases[0].body)
    normaliser = fit_normaliser(np.concatenate([database.features for database in databases]), layout, "")
    return [normaliser.apply(database.features) for database in databases]


def _database_of(name: str, clip: Clip) -> MatchingDatabase:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    return build_database([SourceClip(name, name, clip)], body)
