"""Landmarks of a body: the joints from which the upward direction, the stature and the ground are determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.rigs import JointMapping, map_joints
from marey_motion.rigs.mapping import LEAST_CONFIDENCE
from marey_motion.skeleton import Skeleton

# Number of skeletons whose anatomy and measures are cached.
KEPT_SKELETONS = 256


@dataclass(frozen=True)
class Landmarks:
    """Joint indices of the landmarks of a body; None for a landmark that was not found.

    `hips` is the lowest joint from which both feet descend. The pairs are (left, right); `feet` are the ankles and
    `hands` the wrists. `by_names` is true if the joints were clearly recognised by their names; otherwise, the skeleton
    may be that of an animal.
    """

    hips: int | None = None
    head: int | None = None
    feet: tuple[int, int] | None = None
    toes: tuple[int, int] | None = None
    hands: tuple[int, int] | None = None
    by_names: bool = False

    @property
    def ground_joints(self) -> tuple[int, ...]:
        """The joints that touch the ground: the toes, or the feet if there are no toes."""
        return self.toes or self.feet or ()


def find_landmarks(skeleton: Skeleton, mapping: JointMapping | None = None) -> Landmarks:
    """Find the landmarks among the standard joints.

    Parameters
    ----------
    skeleton : Skeleton    joints; lengths may be in any unit and axes in any order
    mapping : JointMapping, optional    its standard joints, if already known

    Returns
    -------
    Landmarks    joint indices
    """
    mapping = mapping or map_joints(skeleton)

    def pair(part: str) -> tuple[int, int] | None:
        names = [mapping.joints.get(f"{side}_{part}") for side in ("left", "right")]
        left, right = (None if name is None else skeleton.index_of(name) for name in names)
        return None if left is None or right is None else (left, right)

    feet, head = pair("ankle"), mapping.joints.get("head")
    if feet and common_ancestor(skeleton.parents, feet) in feet:
        feet = None
    return Landmarks(
        hips=common_ancestor(skeleton.parents, feet) if feet else None,
        head=None if head is None else skeleton.index_of(head),
        feet=feet,
        toes=pair("toe"),
        hands=pair("wrist"),
        by_names=mapping.method == "names" and mapping.confidence >= LEAST_CONFIDENCE,
    )


def path_length(skeleton: Skeleton, top: int, end: int) -> float:
    """Measure the total length of the bones between two joints.

    Parameters
    ----------
    skeleton : Skeleton    the joints
    top, end : int    indices of the upper and the lower joint; `end` must descend from `top`

    Returns
    -------
    float    length in the skeleton's unit
    """
    path = skeleton.path_to_root(end)
    return float(np.linalg.norm(skeleton.offsets[list(path[: path.index(top)])], axis=1).sum())


def common_ancestor(parents: NDArray[np.int32], pair: tuple[int, int]) -> int:
    """Find the lowest joint from which two joints descend.

    Parameters
    ----------
    parents : (J,) int32    index of each joint's parent
    pair : (int, int)    joint indices

    Returns
    -------
    int    joint index
    """
    a, b = pair
    while a != b:
        if a > b:
            a = int(parents[a])
        else:
            b = int(parents[b])
    return a
