"""Generated motions of a body that uses the floor: cartwheels, crawling, push-ups, rolls, falls and kneeling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.gait import studio_skeleton
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton

FRAME_RATE_HZ = 30.0
SIDES = (("Left", 1.0), ("Right", -1.0))

Rotations = dict[str, AnyFloats]
"""Rotations (F, 4) by joint name, relative to the T-pose; joints that are not named keep the T-pose."""


def turned(axis: str, degrees: AnyFloats | float, times: AnyFloats) -> AnyFloats:
    """Return rotations (F, 4) about an axis of a body that faces z; the left side is at +x."""
    angles = np.radians(np.broadcast_to(np.asarray(degrees, np.float64), times.shape))
    return quaternions.from_axis_angle(np.eye(3)["xyz".index(axis)], angles)


def cartwheels(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """Four cartwheels to the left, with arms and legs stretched out."""
    pose = {"Hips": turned("z", -180.0 * times, times)}
    for side, sign in SIDES:
        pose[f"{side}Arm"] = turned("z", sign * 70.0, times)
        pose[f"{side}UpLeg"] = turned("z", sign * (25.0 + 10.0 * np.sin(np.pi * times)), times)
    return pose, np.stack([1.1 * times, 0 * times, 0 * times], axis=1)


def crawl(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """A crawl forwards on hands and knees, the trunk nearly level."""
    pose = {"Hips": turned("x", 80.0, times), "Neck": turned("x", -40.0, times)}
    for side, sign in SIDES:
        swing = 15.0 * sign * np.sin(2 * np.pi * times)
        pose[f"{side}UpLeg"] = turned("x", -80.0 + swing, times)
        pose[f"{side}Leg"] = turned("x", 85.0 - swing, times)
        pose[f"{side}Foot"] = turned("x", 40.0, times)
        pose[f"{side}Arm"] = quaternions.multiply(turned("x", -75.0 - swing, times), turned("z", -sign * 85.0, times))
    return pose, np.stack([0 * times, 0 * times, 0.5 * times], axis=1)


def push_ups(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """Push-ups: the straight body rises and sinks, the hands bear it."""
    depth = 0.5 - 0.5 * np.cos(2 * np.pi * times / 1.5)
    pose = {"Hips": turned("x", 72.0 + 12.0 * depth, times)}
    for side, sign in SIDES:
        pose[f"{side}Arm"] = quaternions.multiply(
            turned("x", -72.0 + 40.0 * depth, times), turned("z", -sign * 85.0, times)
        )
        pose[f"{side}ForeArm"] = turned("y", -sign * 85.0 * depth, times)
        pose[f"{side}Foot"] = turned("x", -40.0, times)
    return pose, np.stack([0 * times, 0 * times, -0.25 * depth], axis=1)


def rolls(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """Rolls forwards of a body that stays crouched."""
    pose = {"Hips": turned("x", 120.0 * times, times), "Spine": turned("x", 50.0, times)}
    for side, sign in SIDES:
        pose[f"{side}UpLeg"] = turned("x", -110.0, times)
        pose[f"{side}Leg"] = turned("x", 120.0, times)
        pose[f"{side}Arm"] = turned("y", -sign * 60.0, times)
    return pose, np.stack([0 * times, 0 * times, 0.7 * times], axis=1)


def fall(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """A fall on the back: the body stands for a third of the time, then falls, lies, and moves its arms."""
    share = times / times[-1]
    lying = np.clip((share - 0.35) / 0.15, 0.0, 1.0)
    pose = {"Hips": turned("x", -88.0 * lying, times)}
    for side, sign in SIDES:
        pose[f"{side}Arm"] = turned("z", -sign * (60.0 + 20.0 * np.sin(4.0 * times)), times)
        pose[f"{side}Leg"] = turned("x", 30.0 * lying * (1.0 + np.sin(3.0 * times)), times)
    return pose, np.stack([0.3 * share, 0 * times, -0.6 * lying], axis=1)


def kneel(times: AnyFloats) -> tuple[Rotations, AnyFloats]:
    """A body on both knees that bends forwards and rises; its soles point up and back."""
    bend = 35.0 + 30.0 * np.sin(2.0 * times)
    pose = {"Hips": turned("x", bend, times)}
    for side, sign in SIDES:
        pose[f"{side}UpLeg"] = turned("x", -bend, times)
        pose[f"{side}Leg"] = turned("x", 95.0, times)
        pose[f"{side}Foot"] = turned("x", 75.0, times)
        pose[f"{side}Arm"] = turned("z", -sign * 70.0, times)
    return pose, np.stack([0 * times, 0 * times, 0.05 * times], axis=1)


FLOOR_WORK = {
    "cartwheels": cartwheels,
    "crawl": crawl,
    "push-ups": push_ups,
    "rolls": rolls,
    "fall": fall,
    "kneel": kneel,
}


def floor_work(name: str, *, heading_deg: float = 0.0, skeleton: Skeleton | None = None, seconds: float = 8.0) -> Clip:
    """Return one of `FLOOR_WORK` on the floor y = 0, in metres, performed along +z turned by `heading_deg` about y."""
    skeleton = skeleton or studio_skeleton()
    times = np.arange(round(seconds * FRAME_RATE_HZ)) / FRAME_RATE_HZ
    pose, ways = FLOOR_WORK[name](times)
    heading = turned("y", heading_deg, times)
    pose["Hips"] = quaternions.multiply(heading, pose["Hips"])
    ways = quaternions.rotate_vectors(heading, ways)
    clip = _posed(skeleton, pose, ways)
    poses = clip.poses.copy()
    poses[:, 1] -= global_positions(clip)[..., 1].min(axis=1)
    return replace(clip, poses=poses)


def _posed(skeleton: Skeleton, pose: Mapping[str, AnyFloats], ways: AnyFloats) -> Clip:
    rotations = np.tile(skeleton.rest_rotations, (len(ways), 1, 1))
    for name, turn in pose.items():
        rotations[:, skeleton.index_of(name)] = turn
    poses = np.concatenate([ways, rotations.reshape(len(ways), -1)], axis=1)
    return Clip(skeleton, FRAME_RATE_HZ, poses.astype(np.float32))


def with_upright_rest(clip: Clip) -> Clip:
    """Return the same motion in a file with z up, by the root's rotation alone: the rest pose keeps y up."""
    quarter = quaternions.from_axis_angle(np.array([1.0, 0.0, 0.0]), np.pi / 2)
    poses = clip.poses.astype(np.float64)
    poses[:, :3] = quaternions.rotate_vectors(quarter, poses[:, :3])
    poses[:, 3:7] = quaternions.multiply(quarter, poses[:, 3:7])
    return replace(clip, poses=poses.astype(np.float32))
