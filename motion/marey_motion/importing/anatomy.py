"""Anatomy of a skeleton: standard joints, landmarks and axes, and the documents that contain them.

An anatomy is computed once for all files with equal skeletons.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.errors import MappingError
from marey_motion.importing.landmarks import KEPT_SKELETONS, Landmarks, find_landmarks, path_length
from marey_motion.importing.source import SourceMotion
from marey_motion.rigs import JointMapping, axes_from_motion, guess_axes, map_joints
from marey_motion.skeleton import EndSite, Skeleton
from marey_schemas.documents.standard_joints import SIDES
from marey_schemas.lru import LruCache

LEG_OF_STATURE = 0.491
"""Length of thigh and shank together, as a share of the stature (Drillis and Contini, 1966)."""

_UNKNOWN_AXES = "the skeleton does not show the axes of all joints; those that are missing are read from each clip"


class Anatomy:
    """Properties that depend only on a skeleton, computed on first use and cached."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton

    @cached_property
    def mapping(self) -> JointMapping:
        """Mapping from standard joints to joints of the skeleton."""
        return map_joints(self.skeleton)

    @cached_property
    def landmarks(self) -> Landmarks:
        """The joints from which the upward direction, the stature and the ground are determined."""
        return find_landmarks(self.skeleton, self.mapping)

    @cached_property
    def leg(self) -> float | None:
        """Mean length of the legs in the skeleton's unit, from hips to ankle; None if unknown or zero."""
        landmarks = self.landmarks
        if not landmarks.feet or landmarks.hips is None:
            return None
        return float(np.mean([path_length(self.skeleton, landmarks.hips, foot) for foot in landmarks.feet])) or None

    @cached_property
    def stature(self) -> float | None:
        """Stature in the skeleton's unit, estimated from thighs and shanks; None if they are unknown or have no length.

        The trunk is not used, because rigs place the joint of the head differently.
        """
        joints = self.mapping.joints
        legs = [
            path_length(self.skeleton, self.skeleton.index_of(hip), self.skeleton.index_of(ankle))
            for side in SIDES
            if (hip := joints.get(f"{side}_hip")) and (ankle := joints.get(f"{side}_ankle"))
        ]
        return float(np.mean(legs)) / LEG_OF_STATURE if any(legs) else None

    @cached_property
    def hierarchy(self) -> dict[str, Any]:
        """Document `hierarchy` of the skeleton."""
        return skeleton_to_document(self.skeleton).model_dump(by_alias=True, exclude_none=True)

    @cached_property
    def mapping_part(self) -> dict[str, Any]:
        """Document `mapping`: standard joints, and the axes that the skeleton alone shows.

        No motion is used, because the document belongs to all takes of the skeleton, whichever is imported first. If
        too few joints are recognised, the document contains a note instead of axes.
        """
        mapping = self.mapping
        try:
            unknown = axes_from_motion(self.skeleton, mapping)
            axes = {name: one for name, one in guess_axes(self.skeleton, mapping).items() if name not in unknown}
            notes = (_UNKNOWN_AXES,) if unknown else ()
        except MappingError as error:
            axes, notes = {}, (f"no axes: {error.message}",)
        document = mapping_to_document(replace(mapping, notes=(*mapping.notes, *notes)), axes)
        return document.model_dump(by_alias=True, exclude_none=True)


_SkeletonKey = tuple[tuple[str, ...] | bytes, ...]

_KNOWN: LruCache[_SkeletonKey, Anatomy] = LruCache(max_entries=KEPT_SKELETONS)


def anatomy_of(skeleton: Skeleton | SourceMotion) -> Anatomy:
    """Return the anatomy of a skeleton; equal skeletons share one cached `Anatomy`.

    Parameters
    ----------
    skeleton : Skeleton or SourceMotion    J joints; two skeletons are equal if all their names and numbers are equal.
        From a `SourceMotion`, a skeleton is made only if the cache has no equal one.

    Returns
    -------
    Anatomy    shared by all equal skeletons
    """
    if isinstance(skeleton, Skeleton):
        return _KNOWN.get_or_make(_content_key(skeleton, skeleton.end_sites), lambda: Anatomy(skeleton))
    return _KNOWN.get_or_make(_content_key(skeleton, ()), lambda: Anatomy(skeleton.skeleton))


def _content_key(joints: Skeleton | SourceMotion, end_sites: tuple[EndSite, ...]) -> _SkeletonKey:
    """Return a key, equal for skeletons with the same names, parents, offsets, rest rotations and `end_sites`."""
    names = tuple(joints.joint_names)
    return (
        names,
        tuple(joints.display_names) or names,
        np.asarray(joints.parents, np.int32).tobytes(),
        np.asarray(joints.offsets, np.float64).tobytes(),
        np.asarray(joints.rest_rotations, np.float64).tobytes(),
        *(b"%d:%b" % (site.joint, site.offset.tobytes()) for site in end_sites),
    )
