"""Synthetic bodies and motions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.skeleton import EndSite, Skeleton

# Name, parent, offset in metres: a T-pose that faces +z, its left at +x.
BODY: tuple[tuple[str, str | None, tuple[float, float, float]], ...] = (
    ("Hips", None, (0.0, 0.95, 0.0)),
    ("LeftUpLeg", "Hips", (0.1, -0.05, 0.0)),
    ("LeftLeg", "LeftUpLeg", (0.0, -0.42, 0.0)),
    ("LeftFoot", "LeftLeg", (0.0, -0.42, 0.0)),
    ("LeftToeBase", "LeftFoot", (0.0, -0.06, 0.14)),
    ("RightUpLeg", "Hips", (-0.1, -0.05, 0.0)),
    ("RightLeg", "RightUpLeg", (0.0, -0.42, 0.0)),
    ("RightFoot", "RightLeg", (0.0, -0.42, 0.0)),
    ("RightToeBase", "RightFoot", (0.0, -0.06, 0.14)),
    ("Spine", "Hips", (0.0, 0.1, 0.0)),
    ("Spine1", "Spine", (0.0, 0.15, 0.0)),
    ("Spine2", "Spine1", (0.0, 0.15, 0.0)),
    ("LeftShoulder", "Spine2", (0.05, 0.12, 0.0)),
    ("LeftArm", "LeftShoulder", (0.12, 0.0, 0.0)),
    ("LeftForeArm", "LeftArm", (0.28, 0.0, 0.0)),
    ("LeftHand", "LeftForeArm", (0.26, 0.0, 0.0)),
    ("RightShoulder", "Spine2", (-0.05, 0.12, 0.0)),
    ("RightArm", "RightShoulder", (-0.12, 0.0, 0.0)),
    ("RightForeArm", "RightArm", (-0.28, 0.0, 0.0)),
    ("RightHand", "RightForeArm", (-0.26, 0.0, 0.0)),
    ("Neck", "Spine2", (0.0, 0.2, 0.0)),
    ("Head", "Neck", (0.0, 0.12, 0.0)),
)
TIPS = {
    "LeftToeBase": (0.0, 0.0, 0.07),
    "RightToeBase": (0.0, 0.0, 0.07),
    "LeftHand": (0.15, 0.0, 0.0),
    "RightHand": (-0.15, 0.0, 0.0),
    "Head": (0.0, 0.18, 0.0),
}


@pytest.fixture
def body() -> Skeleton:
    """A human skeleton of 22 joints in T-pose."""
    names = [name for name, _, _ in BODY]
    return Skeleton(
        joint_names=tuple(names),
        parents=np.array([-1 if parent is None else names.index(parent) for _, parent, _ in BODY], dtype=np.int32),
        offsets=np.array([offset for _, _, offset in BODY]),
        rest_rotations=quaternions.identity(len(names)),
        end_sites=tuple(EndSite(names.index(name), np.array(offset)) for name, offset in TIPS.items()),
    )


@pytest.fixture
def tumbling() -> Callable[..., Clip]:
    """Function that returns a clip of a skeleton: all joints rotate at random, and some also move."""

    def make(skeleton: Skeleton, frames: int = 70, translated: tuple[int, ...] = (), seed: int = 0) -> Clip:
        random = np.random.default_rng(seed)
        joints = skeleton.joint_count
        rotations = quaternions.normalise(random.normal(size=(frames, joints, 4)))
        poses = np.concatenate((random.normal(size=(frames, 3)), rotations.reshape(frames, -1)), axis=1)
        moved: Any = random.normal(size=(frames, len(translated), 3)).astype(np.float32) if translated else None
        return Clip(skeleton, 60.0, poses.astype(np.float32), moved, translated)

    return make
