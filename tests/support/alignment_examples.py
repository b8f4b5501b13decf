"""Clips with known alignments: one walk that is rotated, moved, mirrored, and played at varying speed."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from marey_motion.alignment.aligning import SourceExample
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs import map_joints


@cache
def walk(frames: int = 60, speed: float = 1.3, turn_rate: float = 0.2) -> Clip:
    """Return a walk at 60 Hz that begins at the origin and faces +z."""
    return generate_gait(speed, turn_rate, frames / 60.0)


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def played(clip: Clip, times: Floats) -> Clip:
    """Return the clip at fractional frames `times`, interpolated by a library other than the tested one."""
    frames = np.arange(clip.frame_count)
    root = np.stack([np.interp(times, frames, axis) for axis in clip.root_translations.T.astype(float)], axis=1)
    joints = []
    for rotations in clip.rotations.astype(float).transpose(1, 0, 2):
        found = Slerp(frames, Rotation.from_quat(rotations, scalar_first=True))(times).as_quat(scalar_first=True)
        joints.append(found)
    poses = np.concatenate((root, np.stack(joints, axis=1).reshape(len(times), -1)), axis=1)
    return Clip(clip.skeleton, clip.frame_rate_hz, poses.astype(np.float32))


def moved(clip: Clip, heading_rad: float, x: float, z: float) -> Clip:
    """Return the clip rotated to the left about the origin, then shifted on the ground."""
    turn = Rotation.from_euler("y", heading_rad)
    poses = clip.poses.astype(float).copy()
    poses[:, :3] = turn.apply(poses[:, :3]) + np.array((x, 0.0, z))
    poses[:, 3:7] = (turn * Rotation.from_quat(poses[:, 3:7], scalar_first=True)).as_quat(scalar_first=True)
    return Clip(clip.skeleton, clip.frame_rate_hz, poses.astype(np.float32))


def sine_warp(source_frames: int, frames: int, depth: float = 0.06) -> Floats:
    """Return a warp (frames,): source frames that increase at a varying rate, from the first frame to the last."""
    share = np.linspace(0.0, 1.0, frames)
    return (share + depth * np.sin(2.0 * np.pi * share)) * (source_frames - 1)


def warped_walks(count: int = 6, seed: int = 3, frames: int = 60) -> tuple[list[SourceExample], dict[str, Floats]]:
    """Return examples of one walk with different timing, and the warp of each example by uid.

    A warp states the frame of the walk for each frame of the example.
    """
    random = np.random.default_rng(seed)
    base = walk(frames)
    examples, warps = [SourceExample("clip_a@1", "walk a", base)], {"clip_a@1": np.arange(frames, dtype=float)}
    for index in range(1, count):
        warp = sine_warp(frames, int(random.integers(50, 72)), float(random.uniform(-0.07, 0.07)))
        clip = moved(played(base, warp), *random.uniform(-2.0, 2.0, size=3))
        uid = f"clip_{chr(ord('a') + index)}@1"
        examples.append(SourceExample(uid, f"walk {uid[5]}", clip))
        warps[uid] = warp
    return examples, warps
