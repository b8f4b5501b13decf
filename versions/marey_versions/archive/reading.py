"""Reading and checking of archives."""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.names import is_digest
from marey_schemas.queue.facets import is_facet_name
from marey_schemas.sizes import MIB
from marey_versions.archive.members import (
    MANIFEST,
    MOST_BYTES,
    SCHEMA,
    SCHEMA_WITH_DIFFERENCES,
    SCHEMA_WITH_FACETS,
    ArchiveMember,
    BadArchive,
    MemberKind,
    canonical_tree,
    read_headers,
    require_digest,
    stored_array,
    stored_differences,
)
from marey_versions.records import CommitRecord, DatasetEntry, entry_of, key_of
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory, DamagedChunk, Value
from marey_versions.tree.editing import change
from marey_versions.tree.reading import Tree


@dataclass(frozen=True)
class Manifest:
    """Manifest of an archive, its last member: the dataset, the exported commit, and the commits that it needs."""

    dataset: str
    """Name that the dataset had on its server."""
    commit: str
    """Digest of the exported commit; all other commits in the archive are its ancestors."""
    base: tuple[str, ...]
    """Digests of earlier commits that the archive needs but does not contain; empty if it has the whole history."""


class EntryChange(NamedTuple):
    """Change of an entry between a commit and its first parent."""

    value: Value | None
    """The entry after the commit; None if the commit removed it."""
    unchanged: Mapping[str, str]
    """For each part whose document the archive lacks, the content digest of an earlier revision with this document."""


class Archive:
    """Archive that is open for reading. Each member is read and compared with its digest when it is requested.

    The constructor raises `BadArchive` if the file is not a complete archive, or if the name of a member is not valid.
    The methods raise `BadArchive` if a member that they need is missing or damaged.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.members: dict[ArchiveMember, tuple[int, int]] = {}
        """Position and size in bytes of each member."""
        self.manifest = self._read_headers()

    def _read_headers(self) -> Manifest:
        manifest: Manifest | None = None
        for header in read_headers(self._file):
            if manifest is not None:
                raise BadArchive(
                    f"{header.name}: the member follows {MANIFEST}, which must be the last member, so another program "
                    "changed the archive; export it again"
                )
            if header.name == MANIFEST:
                manifest = _manifest(self._bytes(MANIFEST, header.offset_data, header.size))
            else:
                self._add(ArchiveMember.of_name(header.name), header)
        if manifest is None:
            raise BadArchive(
                f"the archive has no {MANIFEST}: the archive was not written completely, or was cut off; copy or "
                "export it again"
            )
        return manifest

    def _add(self, member: ArchiveMember, header: tarfile.TarInfo) -> None:
        if member in self.members:
            raise BadArchive(f"{member.name}: the archive has two members of this name; export the archive again")
        self.members[member] = (header.offset_data, header.size)

    # -- members -------------------------------------------------------------------------------------------------------

    def tree(self, kind: MemberKind, digest: str) -> Any:
        """Return the parsed JSON of a member that contains a commit, a revision or a document."""
        member = ArchiveMember(kind, digest)
        return canonical_tree(member, self._read(member))

    def array(self, digest: str) -> EncodedArray:
        """Return an array after a check that it can be decoded and has the given digest."""
        member = ArchiveMember(MemberKind.ARRAY, digest)
        return stored_array(member, self._read(member))

    def differences(self, document: str) -> dict[str, ArrayDifference]:
        """Return the arrays of a document that the archive has only as differences, by the digest of the array.

        Only archives that build on earlier versions have differences. A server that has the base of a difference
        compares the array with its digest; this method does not.
        """
        member = ArchiveMember(MemberKind.DIFFERENCES, document)
        if member not in self.members:
            return {}
        if not self.manifest.base:
            raise BadArchive(
                f"{member.name}: an archive with the whole history must contain whole arrays; export the archive again"
            )
        return {one.digest: one for one in stored_differences(member, self._read(member))}

    def file(self, digest: str) -> Iterator[bytes]:
        """Yield the bytes of a file in pieces. Raises `BadArchive` after the last piece if the digest differs."""
        member = ArchiveMember(MemberKind.FILE, digest)
        position, left = self._place(member)
        hashed = hashlib.sha256()
        while left:
            self._file.seek(position)
            piece = self._file.read(min(left, MIB))
            if not piece:
                raise BadArchive(f"{member.name}: the archive was cut off; copy or export it again")
            hashed.update(piece)
            position, left = position + len(piece), left - len(piece)
            yield piece
        require_digest(member, digest_of_hash(hashed))

    def commit(self, digest: str) -> CommitRecord:
        """Return the commit with this digest. Raises `BadArchive` if the archive has no valid commit of this digest."""
        try:
            return CommitRecord.of(self.tree(MemberKind.COMMIT, digest))
        except ValueError as error:
            name = ArchiveMember(MemberKind.COMMIT, digest).name
            raise BadArchive(f"{name}: {error}; export the archive again") from error

    def changes(self, digest: str) -> dict[str, EntryChange]:
        """Return the entries that differ between a commit and its first parent, by key."""
        member = ArchiveMember(MemberKind.CHANGES, digest)
        data = self._read(member)
        try:
            lines = [json.loads(line) for line in data.splitlines()]
            changes = {key_of(str(one["path"]), str(one["kind"])): _change(one) for one in lines}
            same = b"".join(canonical_json(one) + b"\n" for one in lines) == data
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise BadArchive(
                f"{member.name}: the content of the member is not a list of changes; export the archive again"
            ) from error
        if not same:
            raise BadArchive(
                f"{member.name}: the lines are not in canonical form, so another program wrote or changed them; export "
                "the archive again"
            )
        return changes

    def facets(self) -> dict[str, dict[str, float]]:
        """Return the facets (numbers that jobs have published about revisions) by content digest of the revision.

        If an interrupted export has written facets of the same revision before, the newer facets are returned.
        """
        found: dict[str, dict[str, float]] = {}
        for member in self.members:
            if member.kind is MemberKind.FACETS:
                found.update(_facets(member, canonical_tree(member, self._read(member))))
        return found

    def _read(self, member: ArchiveMember) -> bytes:
        return self._bytes(member.name, *self._place(member))

    def _place(self, member: ArchiveMember) -> tuple[int, int]:
        if member not in self.members:
            raise BadArchive(f"{member.name}: the archive has no such member; copy or export it again")
        return self.members[member]

    def _bytes(self, name: str, position: int, size_bytes: int) -> bytes:
        if size_bytes > MOST_BYTES:
            raise BadArchive(
                f"{name}: the member has {size_bytes:,} bytes, but at most {MOST_BYTES:,} are accepted, so another "
                "program wrote or changed the archive; export it again"
            )
        self._file.seek(position)
        data = self._file.read(size_bytes)
        if len(data) < size_bytes:
            raise BadArchive(f"{name}: the archive was cut off; copy or export it again")
        return data

    # -- versions ------------------------------------------------------------------------------------------------------

    def history(self) -> list[tuple[str, CommitRecord]]:
        """Return the commit of the manifest, and those of its ancestors that are in the archive; parents come first."""
        records: dict[str, CommitRecord] = {}
        ordered: dict[str, None] = {}
        path = [self.manifest.commit]
        while path:
            digest = path[-1]
            if digest in records:
                ordered[path.pop()] = None
            else:
                records[digest] = self.commit(digest)
                path += [one for one in records[digest].parents if one not in records and one not in self.manifest.base]
        return [(digest, records[digest]) for digest in ordered]

    def versions(self) -> Versions:
        """Compute the entries of all versions from the changes of their commits.

        Raises `BadArchive` if the digest of a version's entries is not the digest in its commit. Also raises
        `BadArchive` if the archive has only the later part of a history.
        """
        if self.manifest.base:
            earlier = self.manifest.base[0]
            raise BadArchive(
                f"{MANIFEST}: the archive has only the versions after the commit {earlier}; import it into a dataset "
                "that has this commit"
            )
        store = ChunksInMemory()
        empty = build(store, ())
        roots: dict[str, str] = {}
        for digest, record in self.history():
            before = roots[record.parents[0]] if record.parents else empty
            name = ArchiveMember(MemberKind.CHANGES, digest).name
            changes = self.changes(digest)
            try:
                root = change(store, before, {key: one.value for key, one in changes.items()})
            except (TypeError, ValueError) as error:
                raise BadArchive(f"{name}: an entry is not valid ({error}); export the archive again") from error
            if root != record.tree:
                raise BadArchive(
                    f"{name}: with these changes, the entries do not have the digest that the commit states; the "
                    "changes were altered after the archive was written; export it again"
                )
            roots[digest] = root
        return Versions(store, roots)


@dataclass(frozen=True)
class Versions:
    """Entries of the versions in an archive."""

    _store: ChunksInMemory
    _roots: Mapping[str, str]

    def entries(self, commit: str) -> Iterator[DatasetEntry]:
        """Yield the entries of a version, sorted by path.

        Raises `BadArchive` if an entry has a kind that this version of Marey does not know.
        """
        for key, value in Tree(self._store, self._roots[commit]).entries():
            try:
                entry = entry_of(key, value)
            except DamagedChunk as error:
                raise BadArchive(f"the version {commit} cannot be read: {error}; update Marey") from error
            yield entry


def _manifest(data: bytes) -> Manifest:
    try:
        tree = json.loads(data)
        base = tuple(map(str, tree["base"]))
        schema, manifest = tree["schema"], Manifest(str(tree["dataset"]), str(tree["commit"]), base)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadArchive(
            f"{MANIFEST}: the content of the member is not the manifest of an archive; copy or export the archive again"
        ) from error
    if schema not in (SCHEMA, SCHEMA_WITH_FACETS, SCHEMA_WITH_DIFFERENCES):
        raise BadArchive(
            f"{MANIFEST}: this version of Marey reads {SCHEMA_WITH_DIFFERENCES}, not {str(schema)[:80]!r}; update Marey"
        )
    for digest in (manifest.commit, *base):
        if not is_digest(digest):
            raise BadArchive(
                f"{MANIFEST}: {digest[:80]!r} is not the digest of a commit; copy or export the archive again"
            )
    return manifest


def _facets(member: ArchiveMember, tree: Any) -> dict[str, dict[str, float]]:
    by_content: Iterable[tuple[str, Any]] = tree.items() if isinstance(tree, dict) else [("", None)]
    for content, values in by_content:
        named: dict[str, Any] = values if isinstance(values, dict) and is_digest(content) else {"": None}
        numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in named.values())
        if not numbers or not all(map(is_facet_name, named)):
            raise BadArchive(f"{member.name}: the content is not a list of facets; export the archive again")
    return dict(by_content)


def _change(line: Mapping[str, Any]) -> EntryChange:
    if line.get("removed"):
        return EntryChange(None, {})
    parts, tags, unchanged = dict(line["parts"]), list(line["tags"]), dict(line.get("unchanged", {}))
    if not all(isinstance(one, str) for one in (*parts, *parts.values(), *tags, *unchanged, *unchanged.values())):
        raise ValueError("the parts and tags of an entry must be strings")
    return EntryChange({"parts": parts, "tags": tags}, unchanged)
