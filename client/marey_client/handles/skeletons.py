"""Skeletons: joints, rest pose, and the mapping to standard joints."""

from __future__ import annotations

from marey_client.items import ItemHandle
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.items import Item


class SkeletonHandle(ItemHandle):
    """Handle of a skeleton."""

    def hierarchy(self) -> SkeletonHierarchy:
        """Return joints, offsets and rest pose."""
        return SkeletonHierarchy.model_validate(self.part("hierarchy"))

    def mapping(self) -> SkeletonMapping:
        """Return the mapping of standard joints to joints, and the axes of joints."""
        return SkeletonMapping.model_validate(self.part("mapping"))

    def put_mapping(self, mapping: SkeletonMapping) -> Item:
        """Replace the mapping of joints; the item gets a new revision."""
        return self.put_part("mapping", mapping.model_dump(mode="json", by_alias=True))
