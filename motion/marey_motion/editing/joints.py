"""Commands that rotate single joints, or replace the motion of joints with motion from another clip."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.editing.borders import blended, range_weights
from marey_motion.editing.take import Take, motion_of
from marey_motion.editing.translations import translated
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.resampling import sample_motion
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.commands import Paste, RotateJoint

SAME_AXES_RAD = 0.02
"""Largest angle, in radians, between the rest rotations of a joint in two skeletons that counts as no difference."""


def paste(take: Take, command: Paste) -> Take:
    """Replace the motion of joints with a range of another clip (Herrmann et al. 2019, section 4.1.4).

    The source range is resampled with cubic splines to the length of the range to fill; if both ranges have equal
    lengths, the source range is copied exactly. Within the borders, rotations are blended along the shorter arc, and
    translations along straight lines.

    Parameters
    ----------
    take : Take    F frames
    command : Paste    name and range of the other clip, joints, range to fill and borders

    Returns
    -------
    Take    F frames

    Raises
    ------
    UnknownJoint    if a joint does not exist; the error names it
    EditError    if the source or one of the frames is missing, or if the axes of a joint differ in the two skeletons
    """
    clip = take.source(command.source)
    targets = sorted({take.joint(name) for name in command.joints})
    origins = _same_joints(take.skeleton, clip.skeleton, targets)
    span, shares = range_weights(take, command.frames, command.border_s)
    copied = _stretched(take, clip, command.source_frames, len(shares))
    own = _with_more_translations(take, targets, origins, copied)
    rotations, translations = own.rotations.copy(), own.translations.copy()
    rotations[span, targets] = blended(rotations[span, targets], copied.rotations[:, origins], shares)
    for target, origin in zip(targets, origins, strict=True):
        if target in own.translated_joints:
            column = own.translated_joints.index(target)
            there = _translations_of(copied, origin, take.skeleton.offsets[target])
            translations[span, column] += shares[:, None] * (there - translations[span, column])
    return take.with_motion(own._replace(rotations=rotations, translations=translations))


def _same_joints(target: Skeleton, source: Skeleton, joints: Sequence[int]) -> list[int]:
    """Find the indices, in the skeleton `source`, of the joints `joints` of the skeleton `target`, by name.

    Raises `UnknownJoint` if a joint is missing, and `EditError` if the axes of a joint differ.
    """
    origins = [source.index_of(target.joint_names[joint]) for joint in joints]
    apart = quaternions.angle_between(target.rest_rotations[list(joints)], source.rest_rotations[origins])
    odd = np.flatnonzero(apart > SAME_AXES_RAD)
    if odd.size:
        raise EditError(
            "the joint has different orientations in the rest poses of the two skeletons; retarget the "
            "source clip first",
            code="other-axes",
            where=f"joint {target.joint_names[joints[int(odd[0])]]}",
        )
    return origins


def _stretched(take: Take, clip: Clip, frames: tuple[int, int | None] | None, count: int) -> Motion:
    """Resample the range `frames` of a clip to `count` frames. Raises `EditError` if the clip lacks these frames."""
    try:
        start, stop = take.with_motion(motion_of(clip)).frames(frames)
    except EditError as error:
        error.where = "source_frames"
        raise
    places = np.linspace(start, stop - 1, count) if count > 1 else np.array([float(start)])
    return sample_motion(motion_of(clip), places)


def _with_more_translations(take: Take, targets: Sequence[int], origins: Sequence[int], copied: Motion) -> Motion:
    """Add translations to the take's motion for joints that only the copied motion translates.

    `targets` and `origins` are the indices of the same joints in the take and in the copied motion.
    """
    added = (target for target, origin in zip(targets, origins, strict=True) if origin in copied.translated_joints)
    joints = tuple(sorted({*take.motion.translated_joints, *added}))
    return translated(take.motion, take.skeleton, joints)


def _translations_of(motion: Motion, joint: int, offset: Floats) -> Floats:
    """Return the translations (n, 3) of a joint, or `offset` (3,) if the motion has no translations of this joint."""
    if joint not in motion.translated_joints:
        return offset
    return motion.translations[:, motion.translated_joints.index(joint)]


def rotate_joint(take: Take, command: RotateJoint) -> Take:
    """Rotate a joint by an angle that is blended in and out over the borders of the range.

    Parameters
    ----------
    take : Take    F frames
    command : RotateJoint    joint, angle, axis, range and borders

    Returns
    -------
    Take    F frames

    Raises
    ------
    UnknownJoint    if a joint does not exist; the error names it
    EditError    if the take lacks one of the frames
    """
    index = take.joint(command.joint)
    span, shares = range_weights(take, command.frames, command.border_s)
    turns = quaternions.from_axis_angle(command.axis, radians(command.angle_deg) * shares)
    rotations = take.motion.rotations.copy()
    if command.space == "joint":
        rotations[span, index] = quaternions.multiply(rotations[span, index], turns)
        return take.with_motion(take.motion._replace(rotations=rotations))
    parent = int(take.skeleton.parents[index])
    if command.space == "world" and parent >= 0:
        frame = kinematics.as_global_rotations(take.skeleton, rotations[span])[:, parent]
        turns = quaternions.multiply(quaternions.conjugate(frame), quaternions.multiply(turns, frame))
    rotations[span, index] = quaternions.multiply(turns, rotations[span, index])
    return take.with_motion(take.motion._replace(rotations=np.ascontiguousarray(rotations)))
