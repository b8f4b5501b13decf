"""Writing of archives, which can be interrupted and continued."""

from __future__ import annotations

import io
import tarfile
from collections import Counter
from collections.abc import Sequence
from typing import BinaryIO

from marey_schemas.encoding.canonical import canonical_json
from marey_versions.archive.members import (
    MANIFEST,
    SCHEMA,
    SCHEMA_WITH_DIFFERENCES,
    SCHEMA_WITH_FACETS,
    ArchiveMember,
    BadArchive,
    MemberKind,
    read_headers,
)


class ArchiveWriter:
    """Writer of an archive to a file. Members that an interrupted attempt has completely written are kept.

    Members have no times, owners or permissions, so that the file depends on the content of its members alone.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._held, end = _complete_members(file)
        file.seek(end)
        file.truncate()
        self._tar = tarfile.open(fileobj=file, mode="w:", format=tarfile.GNU_FORMAT)  # noqa: SIM115

    def __contains__(self, member: ArchiveMember) -> bool:
        """Return whether the archive has a member already."""
        return member.name in self._held

    def add(self, member: ArchiveMember, data: bytes) -> None:
        """Add a member. Adding it again has no effect."""
        self.add_stream(member, io.BytesIO(data), len(data))

    def add_stream(self, member: ArchiveMember, stream: BinaryIO, size_bytes: int) -> None:
        """Add a member whose bytes are read from a stream. Adding it again has no effect."""
        if member.name not in self._held:
            self._write(member.name, stream, size_bytes)

    def finish(self, dataset: str, commit: str, base: Sequence[str] = ()) -> None:
        """Add the manifest, which says that the archive is complete, and end the file.

        `base` lists the commits that precede those of the archive and that the archive does not contain.
        """
        counts = Counter(name.partition("/")[0] for name in self._held)
        with_facets = SCHEMA_WITH_FACETS if counts[MemberKind.FACETS] else SCHEMA
        manifest = {
            "schema": SCHEMA_WITH_DIFFERENCES if counts[MemberKind.DIFFERENCES] else with_facets,
            "dataset": dataset, "commit": commit, "base": sorted(base),
            "members": dict(sorted(counts.items())),
        }  # fmt: skip
        data = canonical_json(manifest)
        self._write(MANIFEST, io.BytesIO(data), len(data))
        self._tar.close()

    def _write(self, name: str, stream: BinaryIO, size_bytes: int) -> None:
        header = tarfile.TarInfo(name)
        header.size = size_bytes
        self._tar.addfile(header, stream)
        self._held.add(name)


def _complete_members(file: BinaryIO) -> tuple[set[str], int]:
    """Return the names of the complete members of an unfinished archive, and the position after the last of them."""
    names: set[str] = set()
    end = 0
    try:
        for header in read_headers(file):
            if header.name == MANIFEST:
                break
            names.add(header.name)
            end = header.offset_data + -(-header.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
    except BadArchive:
        pass  # the file ends within a member, or has none yet: what was found before it is complete
    return names, end
