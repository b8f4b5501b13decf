"""Import of folders that an export wrote: the clips get back their paths, tags and records of takes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

from marey_client.bridges.sidecars import CARD, RECORDS, TABLE, read_sidecar, write_table
from marey_client.errors import NotFound, NothingToUpload
from marey_client.handles.clips import ClipHandle
from marey_client.items import Items
from marey_schemas.datasets.exports import SIDECAR, ExportedClip, ExportedFolder, ExportedRecord
from marey_schemas.documents.clips import ClipInfo
from marey_schemas.formats import format_named
from marey_schemas.items import ItemChange
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from marey_client.transport import Transport
    from marey_schemas.formats import LengthUnit


@dataclass(frozen=True)
class ReturningFolder:
    """Folder that an export wrote and that is imported again, with its sidecar, the file `marey.json`."""

    folder: Path
    sidecar: ExportedFolder

    @classmethod
    def at(cls, folder: Path) -> Self | None:
        """Return the folder if it has a sidecar, otherwise None.

        Raises `BadSidecar` if the sidecar is damaged, and `NothingToUpload` for a LeRobotDataset.
        """
        sidecar = read_sidecar(folder)
        if sidecar is None:
            return None
        if sidecar.layout == "lerobot":
            raise NothingToUpload(
                f"{folder} is a LeRobotDataset, which cannot be imported; upload a folder that was exported with --as "
                "files"
            )
        return cls(folder, sidecar)

    @property
    def own_files(self) -> tuple[str, ...]:
        """Paths of the files in the folder that only describe the clips, such as the sidecar; they are not imported."""
        return (SIDECAR, RECORDS, *((CARD, TABLE) if self.sidecar.layout == "huggingface" else ()))

    @property
    def unit(self) -> LengthUnit | None:
        """The unit of length of the motion files; None if the sidecar does not name one."""
        return self.sidecar.unit

    @cached_property
    def _by_file(self) -> Mapping[str, ExportedClip]:
        return {clip.file: clip for clip in self.sidecar.clips if clip.file is not None}

    @cached_property
    def clips(self) -> Mapping[str, ExportedClip]:
        """Descriptions of the exported clips, by the name under which the clip's file is imported."""
        return {self.name_of(file): clip for file, clip in self._by_file.items()}

    def name_of(self, file: str) -> str:
        """Return the name under which a file of the folder is imported: the path of its clip with an ending.

        A file that the sidecar does not name keeps its own name.
        """
        clip = self._by_file.get(file)
        if clip is None:
            return file
        endings = format_named(self.sidecar.format).endings if self.sidecar.format else ()
        return clip.path + next((one for one in endings if file.endswith(one)), Path(file).suffix)

    @property
    def table(self) -> Path:
        """Path of the table of take records, a CSV file; it may not exist."""
        return self.folder / RECORDS

    @property
    def table_changed(self) -> bool:
        """Whether the table exists and differs from the take records in the sidecar."""
        if not self.table.is_file():
            return False
        written = io.StringIO(newline="")
        write_table(written, self.sidecar.clips)
        return self.table.read_bytes() != written.getvalue().encode()


def restore_clip(transport: Transport, project: str, item: str, exported: ExportedClip) -> bool:
    """Add the exported tags and fields of the take record that a clip lacks; return whether the clip was changed."""
    clip = Items(transport, project, Kind.CLIP, ClipHandle).get(item)
    try:
        info = clip.info()
    except NotFound:
        info = ClipInfo()
    record = {name: getattr(exported.record, name) for name in ExportedRecord.model_fields}
    missing = {name: value for name, value in record.items() if value is not None and getattr(info, name) is None}
    if missing:
        clip.put_info(info.model_copy(update=missing))
    new_tags = tuple(one for one in exported.tags if one not in clip.item.tags)
    if new_tags:
        clip.change(ItemChange(tags=(*clip.item.tags, *new_tags)))
    return bool(missing or new_tags)
