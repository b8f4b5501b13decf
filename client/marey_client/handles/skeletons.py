"""Handles of skeletons: joints, rest pose, and the joint mapping."""

from __future__ import annotations

from marey_client.arguments import checks_arguments
from marey_client.items import ItemHandle
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.items import Item


@checks_arguments
class SkeletonHandle(ItemHandle):
    """Handle of a skeleton: its hierarchy of joints, and its joint mapping."""

    def hierarchy(self) -> SkeletonHierarchy:
        """Return the part `hierarchy`: joints, offsets and rest pose."""
        return SkeletonHierarchy.model_validate(self.part("hierarchy"))

    def mapping(self) -> SkeletonMapping:
        """Return the part `mapping`: the joint for each standard joint, and the anatomical axes of joints."""
        return SkeletonMapping.model_validate(self.part("mapping"))

    def put_mapping(self, mapping: SkeletonMapping) -> Item:
        """Replace the joint mapping; the item gets a new revision.

        Raises `PreconditionFailed` if the skeleton was changed since it was read.
        """
        return self.put_part("mapping", mapping.model_dump(mode="json", by_alias=True))
