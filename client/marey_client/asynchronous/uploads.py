"""Counterparts of `marey_client.uploads` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.project_items import AsyncProjectItems
from marey_client.imports import FoundFiles
from marey_client.uploads import UploadReport
from marey_schemas.imports import ImportEntry


@counterpart_of(UploadReport)
class AsyncUploadReport(Counterpart):
    """Results of an upload, one entry for each file, in order."""

    _sync: UploadReport

    @property
    def project(self) -> AsyncProjectItems:
        exchanged: AsyncProjectItems = self._as_async(self._sync.project)
        return exchanged

    @property
    def found(self) -> FoundFiles:
        return self._sync.found

    @property
    def entries(self) -> tuple[ImportEntry, ...]:
        return self._sync.entries

    @property
    def restored(self) -> int:
        """Number of clips that got the take record and the tags of an earlier export."""
        return self._sync.restored

    @property
    def failed(self) -> tuple[ImportEntry, ...]:
        """Entries of the files that were refused; `error` gives the reason."""
        return self._sync.failed

    @property
    def left_out(self) -> tuple[Path, ...]:
        """Paths in the folders that were not imported: files in other formats, hidden motion files, skipped folders."""
        return self._sync.left_out

    def clips(self) -> AsyncIterator[AsyncClipHandle]:
        """Yield handles of the imported clips, also of clips that existed before the import."""
        return self._each(self._sync.clips)

    @property
    def summary(self) -> str:
        """A text with the number of files for each outcome, such as created or failed, and the number of frames."""
        return self._sync.summary

    def _repr_html_(self) -> str:
        return self._sync._repr_html_()
