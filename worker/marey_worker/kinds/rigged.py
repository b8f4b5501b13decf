"""Skeletons as retargeting needs them, read once per job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from marey_motion import documents
from marey_motion.rigs import JointAxes, JointMapping, guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.documents import RevisionRef, SkeletonHierarchy, SkeletonMapping
from marey_schemas.kinds import Kind
from marey_worker.context import Context, NoSuchThing


class Rigged(NamedTuple):
    """A skeleton, which of its joints are which, and their axes."""

    skeleton: Skeleton
    mapping: JointMapping
    axes: Mapping[str, JointAxes]


@dataclass(frozen=True)
class RiggedSkeletons:
    """The skeletons that the clips of a job use, by item and revision."""

    context: Context
    known: dict[RevisionRef, Rigged]

    def get(self, ref: RevisionRef) -> Rigged:
        """The skeleton with the mapping stored with it, or a guessed one where it has none.

        Raises `MotionError` where the stored mapping contradicts the skeleton.
        """
        if ref not in self.known:
            self.known[ref] = self._read(ref)
        return self.known[ref]

    def _read(self, ref: RevisionRef) -> Rigged:
        hierarchy = self.context.document(Kind.SKELETON, ref.item, ref.revision, "hierarchy")
        skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
        try:
            stored = self.context.document(Kind.SKELETON, ref.item, ref.revision, "mapping")
        except NoSuchThing:
            mapping = map_joints(skeleton)
            return Rigged(skeleton, mapping, guess_axes(skeleton, mapping))
        mapping, axes = documents.mapping_from_document(SkeletonMapping.model_validate(stored), skeleton)
        return Rigged(skeleton, mapping, axes)
