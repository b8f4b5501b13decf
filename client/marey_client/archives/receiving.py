"""Import of archives into datasets: revisions and commits that the server lacks are sent, and keep their digests."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from marey_client.archives.contents import ArrayBases, bases_of_arrays, request_contents
from marey_client.blobs import Blobs
from marey_client.errors import Conflict, DifferencesRefused, EarlierVersionsMissing, Invalid, LargeCommit
from marey_client.progress import OnProgress
from marey_client.transport import BLOCKS, Transport, as_json, read_model
from marey_schemas.datasets.commits import Commit
from marey_schemas.datasets.contents import (
    MOST_CONTENTS,
    MOST_RECEIVED_CHANGES,
    ContentsRequest,
    PartOfContent,
    ReceivedChange,
    ReceivedCommit,
)
from marey_schemas.documents.blob_references import references_of
from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import attach_arrays
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_schemas.kinds import Kind
from marey_schemas.sizes import KIB, MIB, batched
from marey_versions.archive.members import ArchiveMember, MemberKind
from marey_versions.archive.reading import Archive, EntryChange
from marey_versions.records import CommitRecord, contents_in, path_and_kind, revision_content

MOST_BYTES_SENT = 16 * MIB
"""Total size of documents, in bytes, above which no further revision is added to a request."""
MOST_BYTES_RESTORED = 64 * MIB
"""Greatest total size of the arrays that are sent as differences in one request; one revision may have more.

The server keeps the whole arrays in memory.
"""
LEAST_BYTES_SHARED = 16 * KIB
"""Size of a document in bytes above which only new tiles of its arrays are sent; smaller documents are sent whole."""


class ReceivingDataset(Protocol):
    """Properties and methods of `DatasetHandle` that the import of an archive needs."""

    @property
    def transport(self) -> Transport:
        """The connections to the server."""

    @property
    def project_url(self) -> str:
        """The path of the project, relative to the API's root."""

    @property
    def url(self) -> str:
        """The path of the dataset, relative to the API's root."""

    def at(self, version: str) -> Commit:
        """Return the commit that a version (a branch, a tag or a digest) names."""


def send_versions(
    dataset: ReceivingDataset,
    archive: Archive,
    on_progress: OnProgress,
    has: Callable[[str], bool],
    *,
    begins: str | None = None,
) -> Commit:
    """Record the versions of an archive in a dataset, where they keep their digests; return the newest version.

    `has` returns whether the dataset has a commit. If `begins` names a branch without commits, this branch moves to the
    newest version; no other branch moves. After an interrupted import, the next import sends only the data that the
    server lacks.

    Raises `LargeCommit`, before anything is sent, if the server would refuse one of the versions. Raises
    `DifferencesRefused` if the server refuses revisions whose arrays the archive has only as differences.
    """
    return _Import(dataset, archive, on_progress, has).run(begins)


def require_base(archive: Archive, has: Callable[[str], bool]) -> None:
    """Raise `EarlierVersionsMissing` if the archive builds on a commit for which `has` returns False."""
    for commit in archive.manifest.base:
        if not has(commit):
            raise EarlierVersionsMissing(
                f"the archive builds on the version {commit}, but the dataset does not have this version; first import "
                "an archive that contains it"
            )


def require_receivable(commit: str, changed: int) -> None:
    """Raise `LargeCommit` if a commit changes so many entries that no server would receive it."""
    if changed > MOST_RECEIVED_CHANGES:
        raise LargeCommit(
            f"the commit {commit} changes {changed:,} entries, but a commit that is imported, pushed or pulled may "
            f"change at most {MOST_RECEIVED_CHANGES:,}. The commit can be archived and extracted. To copy the dataset, "
            "commit its entries to another dataset in several steps, and copy that dataset"
        )


class _Revision(NamedTuple):
    """Revision in an archive. `path` is the path of an entry that has this revision; None if no entry has it."""

    kind: str
    parts: Mapping[str, str]
    path: str | None


@dataclass
class _Import:
    """Import of an archive into a dataset, while it runs."""

    dataset: ReceivingDataset
    archive: Archive
    on_progress: OnProgress
    has: Callable[[str], bool]
    """Function that returns whether the dataset has the commit with the given digest."""
    revisions: dict[str, _Revision] = field(default_factory=dict)
    """Revisions of entries, by content digest."""
    present: set[str] = field(default_factory=set)
    """Content digests of the revisions that the project has."""
    sent: set[str] = field(default_factory=set)
    """Content digests of the revisions that were sent."""
    facets: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Facets (published numbers) of the revisions in the archive, by content digest."""
    homes: dict[str, str] = field(default_factory=dict)
    """For each document, by digest: the content digest of a revision that contains the document."""
    earlier: dict[str, str] = field(default_factory=dict)
    """For each revision of an entry, by content digest: the entry's previous revision, if it is known."""
    _newest: dict[str, str] = field(default_factory=dict)
    """For each entry, by key: the content digest of its revision in the newest commit that was read so far."""

    def run(self, begins: str | None) -> Commit:
        require_base(self.archive, self.has)
        self.facets = self.archive.facets()
        history = self.archive.history()
        changes = {digest: self.archive.changes(digest) for digest, _ in history}
        # All at first, because a document may refer to a revision that only a later commit has as an entry.
        put = {digest: self._put(changes[digest]) for digest, _ in history}
        known = self._known(history)
        for digest in changes.keys() - known:
            require_receivable(digest, len(changes[digest]))
        for digest in known & changes.keys():
            self._note(put[digest])
        head, made = self.archive.manifest.commit, None
        for done, (digest, record) in enumerate(history):
            self.on_progress("sending versions", done, len(history))
            if digest not in known:
                self._ensure(put[digest])
            if digest == head:
                self._add_facets()
            begun = begins if digest == head else None
            if digest not in known or begun is not None:
                made = self._send_commit(record, changes[digest], begun)
        return made or self.dataset.at(head)

    def _known(self, history: list[tuple[str, CommitRecord]]) -> set[str]:
        """Return the digests of commits that the dataset has; a dataset with a commit also has all its ancestors."""
        known: set[str] = set()
        for digest, record in reversed(history):
            if digest not in known and not self.has(digest):
                continue
            known.update((digest, *record.parents))
        return known

    def _put(self, changes: Mapping[str, EntryChange]) -> list[str]:
        """Record the revision of each added or changed entry; return the content digests of these revisions."""
        found = []
        for key, (value, unchanged) in changes.items():
            if value is not None:
                path, kind = path_and_kind(key)
                before = next(iter(unchanged.values()), self._newest.get(key))
                for part, content in unchanged.items():
                    self.homes.setdefault(value["parts"][part], content)
                found.append(revision_content(kind, value["parts"]))
                self.revisions.setdefault(found[-1], _Revision(kind, value["parts"], path))
                if before is not None:
                    self.earlier.setdefault(found[-1], before)
                self._newest[key] = found[-1]
        return found

    # -- revisions -----------------------------------------------------------------------------------------------------

    def _ensure(self, contents: Iterable[str]) -> None:
        """Send the revisions that the project lacks; a revision is sent after the revisions to which it refers."""
        missing = self._missing(sorted(set(contents) - self.present))
        referred = {content: self._references(content) for content in missing}
        if further := set[str]().union(*referred.values()) - self.present - referred.keys():
            self._ensure(further)
        while waiting := [content for content in missing if content not in self.present]:
            ready = [content for content in waiting if referred[content] <= self.present]
            for together in self._batches(ready or waiting):
                self._send(together)

    def _references(self, content: str) -> set[str]:
        """Return the digests of the revisions to which a revision refers in documents that the project lacks."""
        documents = [digest for digest in self._revision(content).parts.values() if not self._is_stored(digest)]
        return {one for digest in documents for one in contents_in(self._document(digest))}

    def _missing(self, contents: list[str]) -> list[str]:
        """Ask the server which revisions the project lacks; return these, and record the other ones in `present`."""
        missing = []
        for some in batched(contents, MOST_CONTENTS):
            request = ContentsRequest(revisions=tuple(some))
            found = request_contents(self.dataset.transport, self.dataset.project_url, request)["revisions"]
            missing += [content for content, one in zip(some, found, strict=True) if one is None]
        self._note(set(contents) - set(missing))
        return missing

    def _note(self, contents: Iterable[str]) -> None:
        for content in contents:
            self.present.add(content)
            self.homes.update(dict.fromkeys(self._revision(content).parts.values(), content))

    def _revision(self, content: str) -> _Revision:
        if content not in self.revisions:
            found = self.archive.tree(MemberKind.REVISION, content)
            self.revisions[content] = _Revision(found["kind"], found["parts"], None)
        return self.revisions[content]

    def _is_stored(self, document: str) -> bool:
        """Return whether the project has a document, so that a request can refer to a revision that contains it.

        `homes` names a revision that contains the document. The project has the document if it has this revision. The
        project also has the document if the archive lacks it: the document then belongs to a version before the
        versions in the archive, and the dataset has all of these earlier versions.
        """
        member = ArchiveMember(MemberKind.DOCUMENT, document)
        return document in self.homes and (self.homes[document] in self.present or member not in self.archive.members)

    def _document(self, digest: str) -> Any:
        return self.archive.tree(MemberKind.DOCUMENT, digest)

    def _batches(self, contents: list[str]) -> Iterator[list[str]]:
        """Divide revisions into batches, one for each request; the number and the total size of a batch are limited."""
        batch: list[str] = []
        size_bytes = restored_bytes = 0
        for content in contents:
            documents = self._revision(content).parts.values()
            adds_bytes = sum(one.nbytes for document in documents for one in self._differences(document).values())
            if batch and restored_bytes + adds_bytes > MOST_BYTES_RESTORED:
                yield batch
                batch, size_bytes, restored_bytes = [], 0, 0
            batch.append(content)
            restored_bytes += adds_bytes
            size_bytes += sum(map(self._size_bytes, documents))
            if size_bytes > MOST_BYTES_SENT or len(batch) == MOST_CONTENTS:
                yield batch
                batch, size_bytes, restored_bytes = [], 0, 0
        if batch:
            yield batch

    def _differences(self, document: str) -> dict[str, ArrayDifference]:
        """Return the differences that are sent instead of arrays of a document, by the digest of the whole array."""
        return {} if self._is_stored(document) else self.archive.differences(document)

    def _size_bytes(self, document: str) -> int:
        """Return the size of a document in bytes, without the arrays that are sent as differences from other arrays."""
        if self._is_stored(document):
            return 0
        arrays, _ = references_of("", self._document(document))
        digests = {leaf["content"] for leaf in arrays.values()} - self._differences(document).keys()
        members = [ArchiveMember(MemberKind.ARRAY, digest) for digest in digests]
        members.append(ArchiveMember(MemberKind.DOCUMENT, document))
        return sum(self.archive.members[member][1] for member in members)

    def _send(self, contents: list[str]) -> None:
        sent = []
        bases = self._bases(contents)
        for content in contents:
            one = self._revision(content)
            parts = {part: self._part(digest, bases.get((content, part))) for part, digest in one.parts.items()}
            facets = self.facets.get(content, {})
            sent.append(
                {"content": content, "kind": one.kind, "path": one.path, "parts": parts}
                | ({"facets": facets} if facets else {})  # which servers of earlier versions do not know
            )
        try:
            self.dataset.transport.send_compressed(
                "POST",
                f"{self.dataset.url}/contents",
                content=encode_tree({"revisions": sent}, MSGPACK, arrays="blocks"),
                media_type=BLOCKS,
            )
        except (Conflict, Invalid) as error:
            documents = [document for content in contents for document in self._revision(content).parts.values()]
            if not any(map(self._differences, documents)):
                raise
            raise DifferencesRefused(str(error)) from error
        self._note(contents)
        self.sent.update(contents)

    def _add_facets(self) -> None:
        """Send the facets (published numbers) of revisions that the project already had, without their documents."""
        for some in batched(sorted(self.facets.keys() & self.present - self.sent), MOST_CONTENTS):
            self._send(some)

    def _bases(self, contents: list[str]) -> dict[tuple[str, str], ArrayBases]:
        """Ask for the tiles of arrays in earlier revisions, so that these tiles are not sent again with new arrays.

        The keys of the result are the content digest and the part of the new revision. Small documents are left out.
        """
        places = {
            (content, part): PartOfContent(content=self.earlier[content], part=part)
            for content in contents
            if content in self.earlier
            for part, digest in self._revision(content).parts.items()
            if self._size_bytes(digest) > LEAST_BYTES_SHARED
        }
        return bases_of_arrays(self.dataset.transport, self.dataset.project_url, places)

    def _part(self, digest: str, bases: ArrayBases | None) -> Any:
        """Return a part of a revision for a request: the document, or a reference to a revision that contains it.

        The result is a reference if the project already has the document. Arrays that the archive has as differences
        are sent as differences. Tiles of `bases` are left out of all other arrays.
        """
        if self._is_stored(digest):
            return {"content": self.homes[digest]}
        tree = self._document(digest)
        arrays, files = references_of(str(tree.get("schema")), tree)
        self._send_files(set(files.values()))
        differences = self._differences(digest)
        pointers = {leaf["content"]: pointer for pointer, leaf in arrays.items()}

        def sent(content: str) -> EncodedArray | dict[str, Any]:
            if content in differences:
                return differences[content].document
            array = self.archive.array(content)
            return array if bases is None else bases.without_shared(pointers[content], array)

        return attach_arrays(tree, sent)

    def _send_files(self, digests: set[str]) -> None:
        blobs = Blobs(self.dataset.transport)
        for digest in sorted(blobs.missing(digests)) if digests else ():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "file"
                with path.open("wb") as file:
                    file.writelines(self.archive.file(digest))
                blobs.put_file(path, digest=digest)

    # -- commits -------------------------------------------------------------------------------------------------------

    def _send_commit(self, record: CommitRecord, changes: Mapping[str, EntryChange], begins: str | None) -> Commit:
        request = ReceivedCommit(
            tree=record.tree,
            parents=record.parents,
            author=record.author,
            message=record.message,
            at=record.at,
            changes=tuple(_received(key, change) for key, change in changes.items()),
            begins=begins,
        )
        url = f"{self.dataset.url}/received-commits"
        return read_model(Commit, self.dataset.transport.send_compressed("POST", url, content=as_json(request)))


def _received(key: str, change: EntryChange) -> ReceivedChange:
    path, kind = path_and_kind(key)
    if change.value is None:
        return ReceivedChange(path=path, kind=Kind(kind), parts=None)
    return ReceivedChange(path=path, kind=Kind(kind), parts=change.value["parts"], tags=tuple(change.value["tags"]))
