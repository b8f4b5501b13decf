"""Counterparts of `marey_client.handles.skeletons` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.items import Item


@counterpart_of(SkeletonHandle)
class AsyncSkeletonHandle(AsyncItemHandle):
    """Handle of a skeleton: its hierarchy of joints, and its joint mapping."""

    _sync: SkeletonHandle

    async def hierarchy(self) -> SkeletonHierarchy:
        """Return the part `hierarchy`: joints, offsets and rest pose."""
        return await self._run(self._sync.hierarchy)

    async def mapping(self) -> SkeletonMapping:
        """Return the part `mapping`: the joint for each standard joint, and the anatomical axes of joints."""
        return await self._run(self._sync.mapping)

    async def put_mapping(self, mapping: SkeletonMapping) -> Item:
        """Replace the joint mapping; the item gets a new revision.

        Raises `PreconditionFailed` if the skeleton was changed since it was read.
        """
        return await self._run(self._sync.put_mapping, mapping)
