"""Parquet files of limited size, numbered as LeRobot numbers them."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

from marey_client.errors import MissingPackage

if TYPE_CHECKING:
    import pyarrow as pa

MOST_FILES_PER_CHUNK = 1000
"""Greatest number of files in a folder such as `chunk-000`."""
MOST_FILE_MB = 100
"""Greatest size of a file in MiB; a file with one episode can be larger."""
COMPRESSION = "zstd"


class FilePlace(NamedTuple):
    """Place of a Parquet file: the number of its folder `chunk-...`, and the number of the file in this folder."""

    chunk: int
    file: int

    @property
    def name(self) -> str:
        """The path of the file below `data` or `meta/episodes`."""
        return f"chunk-{self.chunk:03d}/file-{self.file:03d}.parquet"

    @property
    def following(self) -> FilePlace:
        """The place of the next file: in the same folder, or in the next folder if this one is full."""
        last = self.file == MOST_FILES_PER_CHUNK - 1
        return FilePlace(self.chunk + 1, 0) if last else FilePlace(self.chunk, self.file + 1)


def import_pyarrow() -> Any:
    """Return the module `pyarrow`, with `pyarrow.parquet`. Raises `MissingPackage` if pyarrow is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingPackage(
            "the export to LeRobot needs the package pyarrow; install it with: pip install 'marey[bridges]'"
        ) from error
    return pyarrow


class ParquetFiles:
    """Writer of Parquet files below a folder; each added table becomes one row group, all with the same schema.

    A table that would make the present file larger than the limit is added to a new file. Sizes before compression are
    compared, so that the same tables always give the same files.
    """

    def __init__(self, folder: Path, *, most_bytes: int = MOST_FILE_MB << 20) -> None:
        self._folder = folder
        self._most_bytes = most_bytes
        self._parquet = import_pyarrow().parquet
        self._writer: Any = None
        self._bytes = 0
        self._place = FilePlace(0, 0)

    def __enter__(self) -> ParquetFiles:
        return self

    def place_for(self, size_bytes: int) -> FilePlace:
        """Return the numbers of the file to which a table with this size would be added."""
        full = self._bytes > 0 and self._bytes + size_bytes > self._most_bytes
        return self._place.following if full else self._place

    def add(self, table: pa.Table) -> FilePlace:
        """Write a table as one row group; return the numbers of the file that now contains it."""
        size_bytes: int = table.nbytes
        place = self.place_for(size_bytes)
        if place != self._place:
            self._close()
            self._place = place
        if self._writer is None:
            path = self._folder / place.name
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._parquet.ParquetWriter(path, table.schema, compression=COMPRESSION)
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._bytes += size_bytes
        return place

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._close()

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer, self._bytes = None, 0
