"""Counterparts of `marey_client.handles.searches` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.reports import AsyncReportedHandle
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.handles.searches import Constraints, SearchableHandle
from marey_client.keywords.asking import SearchKeywords
from marey_client.keywords.processing import TreeKeywords
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.search import SearchAnswer


@counterpart_of(SearchableHandle)
class AsyncSearchableHandle(AsyncReportedHandle):
    """Handle of an item whose motions can be searched."""

    _sync: SearchableHandle

    async def search(self, constraints: Constraints = (), **options: Unpack[SearchKeywords]) -> SearchAnswer:
        """Return the motion of the model that meets `constraints` best, and the error of each constraint.

        `options` are those of `SearchRequest`. The option `steps` requests a sequence of motions; each step has its own
        constraints and, if it needs another model, the id of that model.
        """
        return await self._run(self._sync.search, constraints, **options)

    async def save_search(
        self,
        path: str | Path,
        constraints: Constraints = (),
        *,
        format: str = DEFAULT_FORMAT,
        unit: str = DEFAULT_UNIT,
        **options: Unpack[SearchKeywords],
    ) -> Path:
        """Write the result of a search to a motion file (bvh, npz or predecessor), and return the path of the file."""
        return await self._run(self._sync.save_search, path, constraints, format=format, unit=unit, **options)

    async def make_tree(
        self, *, seed: int = 0, on_progress: AsyncOnProgress | None = None, **options: Unpack[TreeKeywords]
    ) -> Job:
        """Submit a job that builds the model's part `tree` from samples, and wait for its end.

        Raises `JobUnsuccessful` if the job does not succeed.

        `options` are those of `TreeParams`.
        """
        exchanged: Job = await self._exchange(self._sync.make_tree, seed=seed, on_progress=on_progress, **options)
        return exchanged

    def tree_request(self, **options: Unpack[TreeKeywords]) -> JobCreate:
        """Return the job request of `make_tree`; `options` are those of `TreeParams`."""
        return self._sync.tree_request(**options)
