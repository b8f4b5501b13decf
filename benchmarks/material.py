"""Motion to measure with: the project's own generated gaits, and real capture where MAREY_TEST_MOCAP names a folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.skeleton import Skeleton


def real_folder() -> Path | None:
    """The folder of real motion capture, if there is one."""
    folder = os.environ.get("MAREY_TEST_MOCAP")
    return Path(folder) if folder else None


def noisy_clip(frames: int, joints: int, seed: int = 0) -> Clip:
    """Smooth rotations of every joint with capture noise of 2e-4 rad and 0.05 mm: nothing a codec could guess."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None] / 60.0
    axes = rng.normal(size=(1, joints, 3))
    phase, rate = rng.uniform(0, 6.28, (1, joints, 1)), rng.uniform(0.5, 2.0, (1, joints, 1))
    half = 0.3 * axes * np.sin(phase + 6.28 * rate * time) + rng.normal(scale=1e-4, size=(frames, joints, 3))
    rotations = np.concatenate([np.ones((frames, joints, 1)), half], axis=2)
    rotations /= np.linalg.norm(rotations, axis=2, keepdims=True)
    root = np.concatenate([np.sin(time[:, :, 0]), 0.9 + 0.02 * np.sin(9 * time[:, :, 0]), 1.3 * time[:, :, 0]], axis=1)
    root += rng.normal(scale=5e-5, size=root.shape)
    poses = np.concatenate([root, rotations.reshape(frames, 4 * joints)], axis=1).astype(np.float32)
    return Clip(chain_skeleton(joints, rng), 60.0, poses, None, ())


def chain_skeleton(joints: int, rng: np.random.Generator) -> Skeleton:
    """A tree of `joints` with limbs of about five joints."""
    parents: NDArray[np.int32] = np.array([-1, *(max(0, j - 1) if j % 5 else 0 for j in range(1, joints))], np.int32)
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1))
    return Skeleton(
        tuple(f"joint{j:02d}" for j in range(joints)), parents, rng.normal(scale=0.1, size=(joints, 3)), identity
    )
