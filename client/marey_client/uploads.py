"""Uploads of folders of motion files, with a report on each file."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marey_client.handles.clips import ClipHandle
from marey_client.imports import FoundFiles, Notice, left_out_texts, refusal_text
from marey_client.project_items import ProjectItems
from marey_client.transport import sends_nothing
from marey_schemas.imports import ImportEntry
from marey_schemas.options.imports import ImportOptions
from marey_schemas.wording import counted

NEW_REVISION = "new revision"
OUTCOMES = ("created", NEW_REVISION, "unchanged", "companion", "failed")  # in the order of the summary


@dataclass(frozen=True)
class UploadReport:
    """Results of an upload, one entry for each file, in order."""

    project: ProjectItems = field(repr=False)
    found: FoundFiles
    entries: tuple[ImportEntry, ...]
    restored: int = 0
    """Number of clips that got the take record and the tags of an earlier export."""

    @property
    def failed(self) -> tuple[ImportEntry, ...]:
        """Entries of the files that were refused; `error` gives the reason."""
        return tuple(one for one in self.entries if one.status == "failed")

    @property
    def left_out(self) -> tuple[Path, ...]:
        """Paths in the folders that were not imported: files in other formats, hidden motion files, skipped folders."""
        return self.found.left_out

    def clips(self) -> Iterator[ClipHandle]:
        """Yield handles of the imported clips, also of clips that existed before the import."""
        for entry in self.entries:
            if entry.item is not None and entry.frames is not None:
                yield self.project.clips.get(entry.item)

    @property
    def summary(self) -> str:
        """A text with the number of files for each outcome, such as created or failed, and the number of frames."""
        return outcomes_text(self.entries)

    def __str__(self) -> str:
        """Return the summary, the reason for each refused file, and the files that were left out."""
        return "\n".join([self.summary, *map(refusal_text, self.failed), *left_out_texts(self.left_out)])

    __repr__ = __str__

    @sends_nothing
    def _repr_html_(self) -> str:
        return "".join(f"<p>{html.escape(line)}</p>" for line in str(self).splitlines())


def upload(project: ProjectItems, found: FoundFiles, options: ImportOptions, notice: Notice) -> UploadReport:
    """Import files that were found, and restore the take records of clips that an export wrote.

    If all files come from one export and `options` have no unit, the unit is that of the export. The field `skeleton`
    of `options` is an id or a path. Raises `NoSuchPath` if there is no such skeleton.
    """
    if options.skeleton is not None:
        found_id = project.skeletons[options.skeleton].id
        options = ImportOptions.model_validate({**options.model_dump(exclude_unset=True), "skeleton": found_id})
    if found.unit is not None and not options.model_fields_set & {"unit", "unit_scale_m"}:
        options = ImportOptions.model_validate({**options.model_dump(exclude_unset=True), "unit": found.unit})
    entries = project.imports.upload(found.files, options, notice=notice)
    restored = project.imports.restore(found, entries, notice=notice)
    return UploadReport(project, found, tuple(entries), restored)


def outcomes_text(entries: Sequence[ImportEntry]) -> str:
    """Return a text with the number of files for each outcome, and the number of frames."""
    counts = Counter(map(_outcome, entries))
    changed = sum(entry.skeleton_changed for entry in entries)
    words = {one: f"{counts[one]} {one}" for one in OUTCOMES}
    words[NEW_REVISION] = counted(counts[NEW_REVISION], NEW_REVISION)
    if changed:
        words[NEW_REVISION] += f" (skeleton changed{'' if changed == counts[NEW_REVISION] else f' in {changed}'})"
    outcomes = ", ".join(words[one] for one in OUTCOMES if counts[one])
    frames = sum(entry.frames or 0 for entry in entries if entry.error is None)
    return f"{counted(len(entries), 'file')}: {outcomes}; {counted(frames, 'frame')}"


def _outcome(entry: ImportEntry) -> str:
    """Return the outcome of an import as text: the status, or `new revision` if the item existed before."""
    return NEW_REVISION if entry.status == "created" and (entry.revision or 1) > 1 else entry.status
