"""Sidecars of exported folders: the file `marey.json`, written clip by clip, and read again by imports."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from pydantic import ValidationError

from marey_client.errors import BadSidecar
from marey_schemas.datasets.exports import EXPORT_SCHEMA, SIDECAR, ExportedClip, ExportedFolder
from marey_schemas.documents.clips import TakeRecord
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.validation.reasons import first_reason

MOST_SIDECAR_BYTES = 1 << 30
RECORDS = "records.csv"
"""Name of the CSV table of the take records, which `marey record --table` can read."""
CARD, TABLE = "README.md", "metadata.csv"
"""Names of the dataset card and of the table of clips in a folder for the Hugging Face Hub."""
RECORD_FIELDS = tuple(TakeRecord.model_fields)


class SidecarWriter:
    """Writer of the sidecar and of the table of take records of a folder; it writes clip by clip to save memory."""

    def __init__(self, folder: Path, header: dict[str, Any]) -> None:
        self._folder = folder
        self._header = {"schema": EXPORT_SCHEMA, **header}
        self._licences: set[str] = set()
        self._open = ExitStack()
        self._clips = 0

    def __enter__(self) -> SidecarWriter:
        self._sidecar = self._open.enter_context((self._folder / SIDECAR).open("wb"))
        table = self._open.enter_context((self._folder / RECORDS).open("w", encoding="utf-8", newline=""))
        self._table = begun_table(table)
        self._sidecar.write(canonical_json(self._header)[:-1] + b',"clips":[')
        return self

    def add(self, clip: ExportedClip) -> None:
        """Write a clip to the sidecar and to the table of take records."""
        if clip.record.licence is not None:
            self._licences.add(clip.record.licence)
        document = clip.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        self._sidecar.write((b",\n" if self._clips else b"\n") + canonical_json(document))
        self._table.writerow((clip.path, *record_cells(clip)))
        self._clips += 1

    def finish(self) -> None:
        """Write the end of the sidecar, without which the file is not valid JSON."""
        self._sidecar.write(b"\n]," + canonical_json({"licences": self.licences})[1:] + b"\n")

    @property
    def licences(self) -> list[str]:
        """The different licences of the clips that were added, sorted."""
        return sorted(self._licences)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.__exit__(kind, error, at)


def begun_table(file: TextIO) -> Any:
    """Write the names of the columns to a new table of take records; return a CSV writer for the rows."""
    table = csv.writer(file, lineterminator="\n")
    table.writerow(("clip", *RECORD_FIELDS))
    return table


def write_table(file: TextIO, clips: Iterable[ExportedClip]) -> None:
    """Write the table of take records of all `clips` to a file, as CSV."""
    begun_table(file).writerows((clip.path, *record_cells(clip)) for clip in clips)


def record_cells(clip: ExportedClip) -> tuple[str, ...]:
    """Return the take record of a clip as cells in the order of `RECORD_FIELDS`; absent fields are empty."""
    values = clip.record.model_dump(mode="json")
    return tuple("" if values[name] is None else str(values[name]) for name in RECORD_FIELDS)


def read_sidecar(folder: Path) -> ExportedFolder | None:
    """Return the sidecar of a folder, or None if the folder has no file `marey.json`.

    Raises `BadSidecar` if the file is not the sidecar of an export.
    """
    path = folder / SIDECAR
    if not path.is_file():
        return None
    if path.stat().st_size > MOST_SIDECAR_BYTES:
        raise BadSidecar(
            f"{path} has more than {MOST_SIDECAR_BYTES:,} bytes, so it is not the sidecar of an export; rename it to "
            "import the folder without it"
        )
    try:
        return ExportedFolder.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadSidecar(
            f"{path} is not the sidecar of an export ({first_reason(error)}); restore the file, or rename it to "
            "import the folder without it"
        ) from None
