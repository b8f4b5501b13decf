"""Names of the members of an archive, and checks that the bytes of a member match the digest in its name."""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Any, BinaryIO, NamedTuple

from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import MAX_ARRAY_BYTES, ArrayError, EncodedArray
from marey_schemas.encoding.blocks import BlockError, read_spec
from marey_schemas.encoding.canonical import array_digest, canonical_json
from marey_schemas.encoding.codecs import MSGPACK, CodecError, decode_tree, encode_tree
from marey_schemas.encoding.digests import digest_of
from marey_schemas.sizes import MIB

SCHEMA = "marey/archive@1"
SCHEMA_WITH_FACETS = "marey/archive@2"
"""Schema of archives that have facets; programs that know only the schema without facets refuse these archives."""
SCHEMA_WITH_DIFFERENCES = "marey/archive@3"
"""Schema of archives in which arrays are described by their differences from arrays of earlier versions."""
MANIFEST = "archive.json"
"""Name of the last member. An archive without this member is incomplete."""
MOST_BYTES = 256 * MIB
"""Greatest size of a member that is read into memory; only files may be larger."""


class BadArchive(Exception):
    """The file is not an archive, or the archive is incomplete or damaged; the message names the faulty member."""


class MemberKind(StrEnum):
    """Kind of a member, and the name of its folder in the archive."""

    COMMIT = "commits"
    CHANGES = "changes"
    """Entries that differ between a commit and its first parent; the digest in the name is that of the commit."""
    REVISION = "revisions"
    """Revision that documents refer to: its kind, and the content digests of its parts."""
    FACETS = "facets"
    """Facets of revisions: for each content digest of a revision, the values of its facets by name."""
    DIFFERENCES = "differences"
    """Arrays of a document that the archive has only as differences; the digest in the name is that of the document.

    Only the temporary archives of pushes and pulls have such members.
    """
    DOCUMENT = "documents"
    ARRAY = "arrays"
    FILE = "files"

    @property
    def ending(self) -> str:
        """The file name extension of members of this kind."""
        return _ENDINGS.get(self, ".json")


_ENDINGS = {
    MemberKind.CHANGES: ".jsonl",
    MemberKind.DIFFERENCES: ".msgpack",
    MemberKind.ARRAY: ".blocks",
    MemberKind.FILE: "",
}
_NAME = re.compile(r"([a-z]+)/([0-9a-f]{64})([.a-z]*)")


class ArchiveMember(NamedTuple):
    """Member of an archive: its kind, and the digest that is part of its name."""

    kind: MemberKind
    digest: str

    @property
    def name(self) -> str:
        """The name of the member in the archive, such as `files/<64 hexadecimal digits>`."""
        return f"{self.kind.value}/{self.digest.removeprefix('sha256:')}{self.kind.ending}"

    @classmethod
    def of_name(cls, name: str) -> ArchiveMember:
        """Parse the name of a member. Raises `BadArchive` for a text that is not the name of a member."""
        found = _NAME.fullmatch(name)
        try:
            member = None if found is None else cls(MemberKind(found[1]), f"sha256:{found[2]}")
        except ValueError:
            member = None
        if member is None or member.name != name:
            raise BadArchive(
                f"{name}: no member of an archive has such a name, so another program wrote or changed the file; "
                "export the archive again"
            )
        return member


def read_headers(file: BinaryIO) -> Iterator[tarfile.TarInfo]:
    """Yield the header of each member of an archive, with the position of the member's bytes.

    Only headers of the kind that `ArchiveWriter` writes are accepted. Other headers, such as those for long names, can
    make a reader use as much memory as the file has bytes. Raises `BadArchive` for other headers, and if the file was
    cut off.
    """
    size_bytes = file.seek(0, io.SEEK_END)
    position = 0
    while True:
        file.seek(position)
        block = file.read(tarfile.BLOCKSIZE)
        if block == bytes(tarfile.BLOCKSIZE):
            return
        try:
            header = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
        except (tarfile.TarError, ValueError) as error:
            raise BadArchive(
                f"the file is not an archive, or its content after {position:,} bytes is damaged or missing ({error}); "
                "copy or export the archive again"
            ) from error
        if header.type != tarfile.REGTYPE or header.size < 0:
            raise BadArchive(
                f"{header.name}: the member is not a regular file, so another program wrote or changed the archive; "
                "export it again"
            )
        header.offset_data = position + tarfile.BLOCKSIZE
        position = header.offset_data + -(-header.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
        if position > size_bytes:
            raise BadArchive(f"{header.name}: the archive was cut off; copy or export it again")
        yield header


def canonical_tree(member: ArchiveMember, data: bytes) -> Any:
    """Parse the JSON of a member.

    Raises `BadArchive` if the data do not have the digest in the member's name, or are not canonical JSON.
    """
    require_digest(member, digest_of(data))
    try:
        tree = json.loads(data)
        same = canonical_json(tree) == data
    except (ValueError, RecursionError, TypeError, OverflowError) as error:
        raise BadArchive(
            f"{member.name}: the content of the member is not JSON ({error}); export the archive again"
        ) from error
    if not same:
        raise BadArchive(
            f"{member.name}: the JSON is not in canonical form, so another program wrote it; export the archive again"
        )
    return tree


def stored_array(member: ArchiveMember, data: bytes) -> EncodedArray:
    """Return the array of a member.

    Raises `BadArchive` if the array cannot be decoded, or does not have the digest in the member's name.
    """
    try:
        spec = read_spec(data)
        array = EncodedArray(spec.dtype, spec.shape, data)
        decoded = array.decode(max_bytes=MAX_ARRAY_BYTES)
    except (ArrayError, BlockError) as error:
        raise BadArchive(f"{member.name}: {error}; copy or export the archive again") from error
    require_digest(member, array_digest(decoded))
    return EncodedArray(spec.dtype, spec.shape, data, decoded)


def differences_member(differences: Iterable[ArrayDifference]) -> bytes:
    """Return the content of a member with the differences of the arrays of a document."""
    return encode_tree([one.document for one in differences], MSGPACK, arrays="blocks")


def stored_differences(member: ArchiveMember, data: bytes) -> list[ArrayDifference]:
    """Return the differences in a member. Raises `BadArchive` if the member is not a list of array differences."""
    try:
        found = [ArrayDifference.of(one) for one in decode_tree(data, MSGPACK, keep_blocks=True)]
    except (ArrayError, CodecError, TypeError) as error:
        raise BadArchive(f"{member.name}: {error}; copy or export the archive again") from error
    differences = [one for one in found if one is not None]
    if len(differences) < len(found):
        raise BadArchive(
            f"{member.name}: the content of the member is not a list of array differences; export the archive again"
        )
    return differences


def require_digest(member: ArchiveMember, digest: str) -> None:
    """Raise `BadArchive` if the digest of a member's content is not the digest in the member's name."""
    if digest != member.digest:
        raise BadArchive(
            f"{member.name}: the content has the digest {digest}, so it was changed or damaged; copy or export the "
            "archive again"
        )
