"""Cache of skeletons and retargeting plans, kept between the jobs of a process, because revisions never change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from marey_motion import documents
from marey_motion.clip import Clip
from marey_motion.errors import MappingError
from marey_motion.retargeting import RetargetPlan, plan_retarget
from marey_motion.rigs import (
    JointAxes,
    JointMapping,
    axes_from_motion,
    doubtful_joints,
    guess_axes,
)
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_worker.context import Context

MOST_KEPT = 512


class MappedSkeleton(NamedTuple):
    """Skeleton with its joint mapping and axes.

    `guessed` contains the joints whose axes are only guessed, because the skeleton does not show them and no person has
    stated them. A motion shows these axes better.
    """

    skeleton: Skeleton
    mapping: JointMapping
    axes: Mapping[str, JointAxes]
    guessed: frozenset[str]

    def seen_in(self, clip: Clip) -> MappedSkeleton:
        """Return the skeleton with the axes that a clip shows in place of those that are guessed."""
        if not self.guessed:
            return self
        seen = guess_axes(self.skeleton, self.mapping, clip)
        return self._replace(axes={**self.axes, **{name: seen[name] for name in self.guessed}})


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


def plan_between(context: Context, source: Rig, target: Rig, scale: float | None, clip: Clip) -> RetargetPlan:
    """Return the plan for retargeting a clip from one skeleton to another.

    `scale` is the number of metres that the target's pelvis moves per metre of the source's pelvis; None: it is
    computed from the skeletons. `clip` has the source's skeleton; the axes of its `guessed` joints are taken from the
    clip. Raises `MotionError` if a joint mapping cannot be used, or if joints or axes that the plan needs are missing.
    """
    mapped = read_mapped(context, source)

    def plan() -> RetargetPlan:
        seen, to = mapped.seen_in(clip), read_mapped(context, target)
        return plan_retarget(seen.skeleton, seen.mapping, seen.axes, to.skeleton, to.mapping, to.axes, scale=scale)

    return plan() if mapped.guessed else _plans.get_or_make((source, target, scale), plan)


def _read(context: Context, rig: Rig) -> MappedSkeleton:
    hierarchy = context.document(Kind.SKELETON, rig.skeleton.item, rig.skeleton.revision, "hierarchy")
    skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
    stored = context.document(Kind.SKELETON, rig.mapping.item, rig.mapping.revision, "mapping", required=False)
    document = None if stored is None else SkeletonMapping.model_validate(stored)
    return _with_axes(skeleton, *documents.trusted_mapping(document, skeleton))


def _with_axes(skeleton: Skeleton, mapping: JointMapping, stored: Mapping[str, JointAxes]) -> MappedSkeleton:
    """Complete the stored axes by those that the skeleton shows, and note which axes can only be guessed.

    Imports used to read axes that the rest pose does not show from the first clip of the skeleton. Such axes depend on
    the order of imports, so they are not used. Axes in a document that a person has edited are used as they are.
    """
    try:
        if mapping.method != "manual":
            doubtful = doubtful_joints(skeleton, mapping)
            stored = {name: axes for name, axes in stored.items() if name not in doubtful}
        axes = {**guess_axes(skeleton, mapping), **stored}
        return MappedSkeleton(skeleton, mapping, axes, axes_from_motion(skeleton, mapping) - stored.keys())
    except MappingError:  # the plan names the joints whose axes are missing
        return MappedSkeleton(skeleton, mapping, stored, frozenset())
