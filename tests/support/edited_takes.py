"""Walks to edit, and checks that every clip created by an edit must pass."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tests.support.present import present

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.gait import generate_gait
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton


def make_walk(
    turn_rate_rad_s: float = 0.0, seconds: float = 3.0, rate_hz: float = 60.0, speed_m_s: float = 1.3
) -> Clip:
    """Return a generated walk; feet in contact do not slide, and the floor is at height zero."""
    return generate_gait(speed_m_s, turn_rate_rad_s, seconds, rate_hz)


def make_breathing_walk(**given: float) -> Clip:
    """Return a walk whose spine and left arm also move relative to their parents."""
    walk = make_walk(**given)
    joints = tuple(sorted(walk.skeleton.index_of(name) for name in ("Spine1", "LeftArm")))
    phase = np.linspace(0.0, 6.0, walk.frame_count)[:, None, None]
    offsets = walk.skeleton.offsets[list(joints)] * (1.0 + 0.1 * np.sin(phase))
    return replace(walk, translations=offsets.astype(np.float32), translated_joints=joints)


def under_static_root(clip: Clip, away: ArrayLike = (0.3, 0.9, -4.0)) -> Clip:
    """Return the same motion with a new root on the floor that does not move; the hips move at the offset `away`."""
    own = clip.skeleton
    skeleton = Skeleton(
        ("reference", *own.joint_names),
        np.concatenate(([-1], own.parents + 1)).astype(np.int32),
        np.concatenate((np.zeros((1, 3)), np.reshape(away, (1, 3)), own.offsets[1:])),
        np.concatenate((quaternions.identity(1), own.rest_rotations)),
    )
    still = np.tile(np.array((0, 0, 0, 1, 0, 0, 0), np.float32), (clip.frame_count, 1))
    poses = np.concatenate((still, clip.poses[:, 3:]), axis=1)
    return Clip(skeleton, clip.frame_rate_hz, poses, clip.poses[:, None, :3], (1,))


def same_poses(a: Clip, b: Clip, tolerance: float = 2e-6) -> bool:
    """Return whether two clips have the same motion, joint by joint, whatever the signs of their quaternions."""
    if a.frame_count != b.frame_count or a.translated_joints != b.translated_joints:
        return False
    turned = quaternions.angle_between(a.rotations.astype(np.float64), b.rotations.astype(np.float64))
    moved = a.translations is None or np.allclose(a.translations, present(b.translations), atol=tolerance)
    return bool(turned.max() < 5 * tolerance and moved) and np.allclose(
        a.root_translations, b.root_translations, atol=tolerance
    )


def are_exactly(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """Return whether rotations are equal in every bit, except for the signs of whole quaternions."""
    return bool(np.all(np.all(a == b, axis=-1) | np.all(a == -b, axis=-1)))


def require_sound(clip: Clip) -> None:
    """Check that every frame has unit quaternions of continuous sign."""
    rotations = clip.rotations.astype(np.float64)
    assert np.abs(np.linalg.norm(rotations, axis=-1) - 1.0).max() < 1e-6
    assert np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]).min(initial=1.0) >= -1e-6


def largest_step(clip: Clip) -> float:
    """Return the largest distance in metres by which a joint moves between consecutive frames."""
    steps = np.linalg.norm(np.diff(global_positions(clip).astype(np.float64), axis=0), axis=-1)
    return float(steps.max())
