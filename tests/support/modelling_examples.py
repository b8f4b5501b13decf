"""Synthetic aligned examples with exactly known values, for tests of models."""

import numpy as np

from marey_motion.alignment.aligned import AlignedClip, AlignedSet, Placement
from marey_motion.arrays import Floats
from marey_motion.gait import generate_gait
from marey_motion.modelling.splines import SplineBasis
from marey_motion.motion import Motion
from marey_motion.skeleton import EndSite, Skeleton

HZ = 60.0


def chain(joints: int = 4) -> Skeleton:
    """Return an upright chain of bones of 30 cm each above a root; the chain ends with a tip."""
    offsets = np.zeros((joints, 3))
    offsets[1:, 1] = 0.3
    parents = np.arange(-1, joints - 1, dtype=np.int32)
    at_rest = np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1))
    names = tuple(f"bone_{index}" for index in range(joints))
    return Skeleton(names, parents, offsets, at_rest, (EndSite(joints - 1, np.array([0.0, 0.3, 0.0])),))


def unit_poses(poses: Floats) -> Floats:
    """Return poses (..., 3 + 4·J) with their quaternions scaled to unit length."""
    rotations = poses[..., 3:].reshape(*poses.shape[:-1], -1, 4)
    rotations = rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
    return np.concatenate((poses[..., :3], rotations.reshape(*poses.shape[:-1], -1)), axis=-1)


def as_motion(poses: Floats) -> Motion:
    frames = len(poses)
    return Motion(poses[:, :3].copy(), poses[:, 3:].reshape(frames, -1, 4).copy(), np.zeros((frames, 0, 3)), ())


def aligned_set(
    skeleton: Skeleton, poses: Floats, time_functions: Floats | None = None, keyframes: dict[str, int] | None = None
) -> AlignedSet:
    """Return examples with these poses (m, N, 3 + 4·J) and time warps (m, N); by default, times are not warped."""
    clips = []
    for index, one in enumerate(poses):
        times = np.arange(len(one), dtype=float) if time_functions is None else time_functions[index]
        uid = f"clip_{index:03}@1"
        place = Placement(0.0, 0.0, 0.0)
        clips.append(AlignedClip(uid, f"clip {index}", as_motion(one), times, place, 1e-4, round(times[-1]) + 1))
    return AlignedSet(skeleton, HZ, tuple(clips), "clip_000@1", keyframes or {})


def warps(count: int, frames: int, seed: int = 0) -> Floats:
    """Return time warps (count, N), each with its own varying slope."""
    random = np.random.default_rng(seed)
    phase = np.linspace(0.0, np.pi, frames - 1)
    slopes = np.exp(
        0.15 * random.standard_normal((count, 1)) + 0.2 * random.standard_normal((count, 1)) * np.sin(phase)
    )
    return np.concatenate((np.zeros((count, 1)), np.cumsum(slopes, axis=1)), axis=1)


def bending_chains(count: int = 20, frames: int = 30, seed: int = 0, joints: int = 4, size: float = 0.1) -> AlignedSet:
    """Return swaying chains: a few random smooth functions in every channel."""
    random = np.random.default_rng(seed)
    skeleton = chain(joints)
    basis = SplineBasis.clamped(frames, 7)
    rest = np.concatenate((np.zeros(3), np.tile([1.0, 0.0, 0.0, 0.0], joints)))
    modes = size * random.standard_normal((3, 7, 3 + 4 * joints))
    coefficients = rest + np.tensordot(random.standard_normal((count, 3)), modes, axes=1)
    return aligned_set(skeleton, unit_poses(basis.at_frames @ coefficients), warps(count, frames, seed))


def walks(count: int = 16, frames: int = 40, seed: int = 0) -> AlignedSet:
    """Return a set of generated walks of many speeds and turn rates; all begin in the same phase of the gait."""
    random = np.random.default_rng(seed)
    clips = [generate_gait(0.9 + 0.7 * random.random(), 0.3 * random.standard_normal(), 1.0) for _ in range(count)]
    poses = np.stack([Motion.of(clip).at_frames(np.arange(frames)).poses for clip in clips])
    return aligned_set(clips[0].skeleton, poses, warps(count, frames, seed), {"contact": frames // 2})
