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
    """Handle of a skeleton."""

    _sync: SkeletonHandle

    async def hierarchy(self) -> SkeletonHierarchy:
        """Return joints, offsets and rest pose."""
        return await self._run(self._sync.hierarchy)

    async def mapping(self) -> SkeletonMapping:
        """Return the mapping of standard joints to joints, and the axes of joints."""
        return await self._run(self._sync.mapping)

    async def put_mapping(self, mapping: SkeletonMapping) -> Item:
        """Replace the mapping of joints; the item gets a new revision."""
        return await self._run(self._sync.put_mapping, mapping)
