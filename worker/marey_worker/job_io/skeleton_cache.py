"""Cache of skeletons and retargeting plans, kept between the jobs of a process, because revisions never change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from marey_motion import documents
from marey_motion.retargeting import RetargetPlan, plan_retarget
from marey_motion.rigs import JointAxes, JointMapping, guess_axes, map_joints, require_trust
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_worker.context import Context

MOST_KEPT = 512


class MappedSkeleton(NamedTuple):
    """Skeleton with its joint mapping and axes."""

    skeleton: Skeleton
    mapping: JointMapping
    axes: Mapping[str, JointAxes]


class Rig(NamedTuple):
    """Reference to a skeleton: a revision of its hierarchy, and the revision whose joint mapping is used."""

    skeleton: RevisionRef
    mapping: RevisionRef

    @classmethod
    def as_stored(cls, ref: RevisionRef) -> Rig:
        """Return a `Rig` in which hierarchy and joint mapping come from the same revision."""
        return cls(ref, ref)


_skeletons: LruCache[Rig, MappedSkeleton] = LruCache(max_entries=MOST_KEPT)
_plans: LruCache[tuple[Rig, Rig, float | None], RetargetPlan] = LruCache(max_entries=MOST_KEPT)


def read_mapped(context: Context, rig: Rig) -> MappedSkeleton:
    """Return a skeleton with its joint mapping, or a guessed mapping if it has none.

    Raises `MotionError` if the mapping contradicts the skeleton, or maps too few joints to be trusted.
    """
    return _skeletons.get_or_make(rig, lambda: _read(context, rig))


def plan_between(context: Context, source: Rig, target: Rig, scale: float | None) -> RetargetPlan:
    """Return the plan for retargeting from one skeleton to another.

    `scale` is the number of metres that the target's pelvis moves per metre of the source's pelvis; None: it is
    computed from the skeletons. Raises `MotionError` if a joint mapping cannot be used, or if joints or axes that the
    plan needs are missing.
    """

    def plan() -> RetargetPlan:
        return plan_retarget(*read_mapped(context, source), *read_mapped(context, target), scale=scale)

    return _plans.get_or_make((source, target, scale), plan)


def _read(context: Context, rig: Rig) -> MappedSkeleton:
    hierarchy = context.document(Kind.SKELETON, rig.skeleton.item, rig.skeleton.revision, "hierarchy")
    skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
    stored = context.document(Kind.SKELETON, rig.mapping.item, rig.mapping.revision, "mapping", required=False)
    if stored is None:
        mapping = require_trust(map_joints(skeleton))
        return MappedSkeleton(skeleton, mapping, guess_axes(skeleton, mapping))
    mapping, axes = documents.mapping_from_document(SkeletonMapping.model_validate(stored), skeleton)
    return MappedSkeleton(skeleton, require_trust(mapping), axes)
