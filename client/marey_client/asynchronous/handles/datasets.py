"""Counterparts of `marey_client.handles.datasets` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.handles.versions import AsyncDatasetHandle
from marey_client.asynchronous.progress import AsyncOnProgress
from marey_client.handles.datasets import Datasets, ImportedVersion
from marey_client.progress import ignore_progress
from marey_schemas.datasets.naming import MAIN, Dataset


@counterpart_of(Datasets)
class AsyncDatasets(Counterpart):
    """Datasets of a project, and imports of versions into them."""

    _sync: Datasets

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        """The path of the datasets, relative to the API's root."""
        return self._sync.url

    async def create(self, name: str, *, collection: str | None = None, description: str = "") -> AsyncDatasetHandle:
        """Create a dataset, whose commits record the content of the folder `collection` if one is given."""
        exchanged: AsyncDatasetHandle = await self._exchange(
            self._sync.create, name, collection=collection, description=description
        )
        return exchanged

    def list(self) -> AsyncIterator[Dataset]:
        """List the datasets by name."""
        return self._each(self._sync.list)

    async def import_archive(
        self, path: str | Path, name: str, *, into: str = MAIN, on_progress: AsyncOnProgress = ignore_progress
    ) -> ImportedVersion:
        """Check an archive, and record its versions in a dataset, which is created if it does not exist.

        The versions keep their digests, and no folder is changed. The branch `into` is created if it does not exist. If
        the newest commit of the branch is an ancestor of the newest imported version, the branch moves to this version.
        Otherwise, the branch does not move, and the caller can merge the version into the branch.

        Raises `marey_versions.archive.members.BadArchive`, which names the member that was changed or is missing, and
        `EarlierVersionsMissing` if the archive builds on a version that the dataset does not have. Raises `LargeCommit`
        if a version changes more entries than an imported version may change.
        """
        exchanged: ImportedVersion = await self._exchange(
            self._sync.import_archive, path, name, into=into, on_progress=on_progress
        )
        return exchanged

    async def pull(
        self,
        source: AsyncDatasetHandle,
        name: str,
        version: str = MAIN,
        *,
        into: str | None = None,
        on_progress: AsyncOnProgress = ignore_progress,
    ) -> ImportedVersion:
        """Copy a version of another dataset, and all versions before it, into the dataset `name` of this project.

        `source` may be on another server. The dataset `name` is created if it does not exist, and only what this
        dataset lacks is copied. The next call continues an interrupted copy. The branch `into` moves as in
        `import_archive`; by default, it is the branch that `version` names, or `main` if `version` is not a branch. If
        `version` is a tag, the tag is created too, unless a branch or tag of this name exists.
        """
        exchanged: ImportedVersion = await self._exchange(
            self._sync.pull, source, name, version, into=into, on_progress=on_progress
        )
        return exchanged

    def at(self, name: str) -> AsyncDatasetHandle:
        """Return a handle of the dataset with this name; no request is sent."""
        exchanged: AsyncDatasetHandle = self._now(self._sync.at, name)
        return exchanged
