"""Positions, velocities and contacts of the joints of stored motions; computed by `marey_motion` from local rotations.

Only the requested frames are read, and only the requested joints and their ancestors. Skeletons are read once per
connection.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import several
from marey_client.errors import NoSuchJoint
from marey_client.extras import import_optional
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.items import ItemHandle
from marey_client.poses.arrays import Joints, PosedItem, frames_text
from marey_client.transport import Transport
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import Joint, SkeletonHierarchy
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_schemas.wording import nearest

MOTION_EXTRA = "motion"
DIFFERENCE_FRAMES = 2
"""Greatest number of frames before and after a range that its velocities depend on.

At the ends of a motion, the velocities are extrapolated from 2 further frames; elsewhere, they depend on 1 frame.
"""
FEET = tuple((f"{side}_toe", f"{side}_ankle") for side in ("left", "right"))
"""Standard joints of the left and the right foot: the toe, or the ankle if the toe is not mapped."""


@dataclass(frozen=True)
class PosedSkeleton:
    """Skeleton at one revision: its handle, and its hierarchy, from which positions are computed."""

    handle: SkeletonHandle
    hierarchy: SkeletonHierarchy

    @cached_property
    def index(self) -> dict[str, int]:
        """The index of each joint, by the joint's name."""
        return {joint.name: place for place, joint in enumerate(self.hierarchy.joints)}

    def chains(self, names: tuple[str, ...]) -> list[int]:
        """Return the indices of joints and of all joints between them and the root, in the order of the skeleton."""
        needed = {0}
        for name in names:
            if name not in self.index:
                near = nearest(name, self.index)
                hint = f"did you mean {near!r}?" if near else "`joints()` returns the names of all joints"
                raise NoSuchJoint(f"the skeleton {self.handle.path!r} has no joint {name!r}; {hint}")
            place = self.index[name]
            while place not in needed:
                needed.add(place)
                place = self.hierarchy.joints[place].parent
        return sorted(needed)

    def part_with(self, places: list[int]) -> SkeletonHierarchy:
        """Return the hierarchy of only the joints with the indices `places`, which must include their parents."""
        new = {old: place for place, old in enumerate(places)} | {-1: -1}
        kept = [self.hierarchy.joints[place] for place in places]
        return SkeletonHierarchy(joints=tuple(Joint(**(dict(joint) | {"parent": new[joint.parent]})) for joint in kept))


_RIGS: WeakKeyDictionary[Transport, dict[tuple[str, str, int], PosedSkeleton]] = WeakKeyDictionary()
"""Skeletons read over each connection, by (project, id, revision) of the skeleton and of each clip that uses it."""


def rig_of(clip: PosedItem) -> PosedSkeleton:
    """Return the skeleton to which the motion in the handle's revision refers."""
    known = _RIGS.setdefault(clip.transport, {})
    by_clip = (clip.project, clip.id, clip.item.revision)
    if by_clip not in known:
        reference = clip.motion(frames=slice(0, 1), revision=clip.item.revision).skeleton
        assert isinstance(reference, RevisionRef)
        by_skeleton = (clip.project, reference.item, reference.revision)
        if by_skeleton not in known:
            known[by_skeleton] = read_rig(clip, reference)
        known[by_clip] = known[by_skeleton]
    return known[by_clip]


def read_rig(clip: ItemHandle, reference: RevisionRef) -> PosedSkeleton:
    """Request the revision of the skeleton to which `reference`, a field of a motion, refers."""
    item = clip.transport.get(Item, f"/projects/{clip.project}/{Kind.SKELETON.plural}/{reference.item}")
    handle = SkeletonHandle(clip.transport, clip.project, item)
    return PosedSkeleton(
        handle, SkeletonHierarchy.model_validate(handle.part("hierarchy", revision=reference.revision))
    )


def read_positions(clip: PosedItem, joints: Joints, frames: slice | None) -> NDArray[np.float32]:
    """Return the positions of joints in the world, (frames, joints, 3) in metres."""
    motion = import_optional("marey_motion", MOTION_EXTRA)
    rig = rig_of(clip)
    names = tuple(joint.name for joint in rig.hierarchy.joints) if joints is None else several(joints)
    places = rig.chains(names)
    chain = [rig.hierarchy.joints[place].name for place in places]
    whole = len(chain) == len(rig.hierarchy.joints)
    poses = clip.motion(frames=frames, joints=None if whole else chain, revision=clip.item.revision)
    skeleton = import_optional("marey_motion.documents", MOTION_EXTRA).skeleton_from_document(rig.part_with(places))
    ordered = _in_order(poses.poses, poses.joints, chain)
    found: NDArray[np.float32] = motion.forward_kinematics(
        skeleton,
        ordered,
        translations=poses.translations,
        translated_joints=[chain.index(name) for name in poses.translated_joints],
    )
    return found if list(names) == chain else found[:, [chain.index(name) for name in names]]


def _in_order(poses: NDArray[np.float32], given: tuple[str, ...], wanted: list[str]) -> NDArray[np.float32]:
    if list(given) == wanted:
        return poses
    turns = poses[:, 3:].reshape(len(poses), -1, 4)[:, [given.index(name) for name in wanted]]
    return np.concatenate((poses[:, :3], turns.reshape(len(poses), -1)), axis=1)


def read_velocities(clip: PosedItem, joints: Joints, frames: slice | None) -> NDArray[np.float32]:
    """Return the velocities of joints in the world, (frames, joints, 3) in metres per second."""
    wider, kept = _widened(clip, frames, DIFFERENCE_FRAMES)
    found: NDArray[np.float32] = import_optional("marey_motion", MOTION_EXTRA).velocities(
        read_positions(clip, joints, wider), clip.frame_rate_hz
    )
    return found[kept]


def read_contacts(clip: PosedItem, frames: slice | None) -> NDArray[np.bool_]:
    """Return whether the left and the right foot touch the ground, as booleans (frames, 2)."""
    motion: Any = import_optional("marey_motion.kinematics", MOTION_EXTRA)
    mapped = rig_of(clip).handle.mapping().joints
    feet = [next((mapped[name] for name in names if name in mapped), None) for names in FEET]
    if None in feet:
        raise NoSuchJoint(
            f"the mapping of the skeleton {rig_of(clip).handle.path!r} has no joints for both feet; add "
            f"{FEET[0][0]} and {FEET[1][0]} to the mapping"
        )
    window = int(motion.CONTACT_WINDOW_S * clip.frame_rate_hz)
    wider, kept = _widened(clip, frames, window + DIFFERENCE_FRAMES)
    toes = read_positions(clip, [str(name) for name in feet], wider)
    found: NDArray[np.bool_] = motion.foot_contacts(toes, clip.frame_rate_hz)
    return found[kept]


def _widened(clip: PosedItem, frames: slice | None, more: int) -> tuple[slice | None, slice]:
    """Return a range of frames extended by `more` on both sides, and the given range as a slice of the extended one.

    A range without frames of the motion is returned as it is, so that reading it is refused.
    """
    frames_text(frames)  # refuses other steps and negative bounds
    if frames is None:
        return None, slice(None)
    first, end = frames.start or 0, clip.frames if frames.stop is None else min(frames.stop, clip.frames)
    if first >= end:
        return frames, slice(None)
    start = max(0, first - more)
    return slice(start, end + more), slice(first - start, end - start)
