"""Documents, arrays and files of an archive that is being written, read from the server by content digest."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from marey_client.archives.contents import first_documents, read_facets, request_contents
from marey_client.blobs import Blobs
from marey_client.errors import Invalid, UnexpectedAnswer
from marey_client.progress import OnProgress
from marey_schemas.datasets.contents import MOST_CONTENTS, ContentsRequest, PartOfContent, RequestedDocument
from marey_schemas.documents.blob_references import references_of
from marey_schemas.encoding.array_differences import ArrayDifference, detach_differences
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json, detach_arrays
from marey_schemas.encoding.digests import digest_of
from marey_schemas.sizes import batched
from marey_versions.archive.members import ArchiveMember, MemberKind, differences_member
from marey_versions.archive.writing import ArchiveWriter
from marey_versions.records import contents_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from marey_client.transport import Transport

OF_UNKNOWN_FIELDS = "invalid-body"
"""Code of the error by which servers of earlier versions refuse requests for differences between arrays."""
CheckContents = Callable[[Sequence[str]], object]
"""Function that may refuse an archive: called with content digests of revisions before their documents are read."""


class EarlierDocument(NamedTuple):
    """Document of an entry before a commit replaced it: the document's digest, and its address on the server."""

    digest: str
    place: PartOfContent


@dataclass
class DocumentWriter:
    """Writer of the documents of an archive, and of the revisions, arrays and files to which the documents refer."""

    transport: Transport
    project_url: str
    writer: ArchiveWriter
    folder: Path
    """Folder for unnamed temporary files, which hold downloaded files until these are in the archive."""
    on_progress: OnProgress
    check: CheckContents
    differences: bool
    """Whether arrays may be replaced by their differences from arrays that the reader of the archive has."""
    known: set[str] = field(default_factory=set)
    """Content digests of the revisions that are in the archive or are about to be added."""
    documents: dict[str, PartOfContent] = field(default_factory=dict)
    """Address on the server of each document of an entry, by the digest of the document."""
    earlier: dict[str, EarlierDocument] = field(default_factory=dict)
    """For each document that replaced another one in a commit, by its digest: the replaced document."""

    def run(self) -> None:
        """Add all documents, and the facets (published numbers) of all revisions."""
        self.check(sorted(self.known))
        self._add_documents(self.documents)
        self._add_facets()

    def _add_documents(self, wanted: Mapping[str, PartOfContent]) -> None:
        """Add documents, given by digest, to the archive.

        New revisions, arrays and files to which a document refers are added before the document.
        """
        digests = [one for one in wanted if ArchiveMember(MemberKind.DOCUMENT, one) not in self.writer]
        total = len(digests)
        while digests:
            trees = self._fetch([self._requested(digest, wanted[digest]) for digest in digests[:MOST_CONTENTS]])
            together = dict(zip(digests, trees, strict=False))
            self._add_together(together)
            digests = digests[len(together) :]
            self.on_progress("reading documents", total - len(digests), total)

    def _add_together(self, trees: Mapping[str, Any]) -> None:
        arrays: dict[str, EncodedArray] = {}

        def keep(name: str, array: NDArray[Any] | EncodedArray) -> None:
            arrays[name] = array if isinstance(array, EncodedArray) else EncodedArray.of(array)

        differences: dict[str, list[ArrayDifference]] = {digest: [] for digest in trees}
        bodies = {
            digest: detach_arrays(detach_differences(tree, differences[digest].append), keep)
            for digest, tree in trees.items()
        }
        self._add_revisions({one for body in bodies.values() for one in contents_in(body)} - self.known)
        for name, array in arrays.items():
            self.writer.add(ArchiveMember(MemberKind.ARRAY, name), array.data)
        for digest, body in bodies.items():
            data = canonical_json(body)
            if digest_of(data) != digest:
                raise UnexpectedAnswer(
                    f"the server's document {digest} does not match its digest; `marey db fsck` on the server finds "
                    "damaged data"
                )
            if found := differences[digest]:
                self.writer.add(ArchiveMember(MemberKind.DIFFERENCES, digest), differences_member(found))
            for file in self._files(digest, body):
                self._add_file(ArchiveMember(MemberKind.FILE, file))
            self.writer.add(ArchiveMember(MemberKind.DOCUMENT, digest), data)

    def _files(self, digest: str, body: Any) -> set[str]:
        """Return the digests of the files that a document names, without files that the replaced document names."""
        named = _files_in(body)
        if named and digest in self.earlier:
            place = self.earlier[digest].place
            (before,) = self._fetch([RequestedDocument(content=place.content, part=place.part)])
            named -= _files_in(before)
        return named

    def _add_revisions(self, contents: Iterable[str]) -> None:
        """Add the revisions to which documents refer, given by content digest, and the documents of these revisions."""
        waiting = sorted(contents)
        self.known.update(waiting)
        self.check(waiting)
        for some in batched(waiting, MOST_CONTENTS):
            found = self._ask(ContentsRequest(revisions=tuple(some)))["revisions"]
            for content, one in zip(some, found, strict=True):
                if one is None:
                    raise UnexpectedAnswer(
                        f"a document refers to the revision with the content digest {content}, which the project "
                        "lacks; `marey db fsck` on the server finds wrong references"
                    )
                self._add_documents(
                    {digest: PartOfContent(content=content, part=part) for part, digest in one["parts"].items()}
                )
                self.writer.add(ArchiveMember(MemberKind.REVISION, content), canonical_json(one))

    def _add_facets(self) -> None:
        """Add the facets (published numbers) of all revisions; jobs may have published them after the commits.

        Each member of the archive contains the facets of a few revisions, because readers refuse members of more than
        `MOST_BYTES`.
        """
        for some in batched(sorted(self.known), MOST_CONTENTS):
            if facets := read_facets(self.transport, self.project_url, some):
                data = canonical_json(facets)
                self.writer.add(ArchiveMember(MemberKind.FACETS, digest_of(data)), data)

    def _add_file(self, member: ArchiveMember) -> None:
        if member in self.writer:
            return
        with tempfile.TemporaryFile(dir=self.folder) as file:  # without a name, so that a killed process leaves none
            Blobs(self.transport).fetch_into(member.digest, file)
            size_bytes = file.tell()
            file.seek(0)
            self.writer.add_stream(member, file, size_bytes)

    def _requested(self, digest: str, place: PartOfContent) -> RequestedDocument:
        """Return the request for a document, if possible as differences from a document that the reader already has.

        The reader has the entries from before the commits in the archive, so a replaced document of such an entry can
        be the base of the differences.
        """
        one: EarlierDocument | None = EarlierDocument(digest, place)
        passed: set[str] = set()
        while self.differences and one is not None and one.digest not in passed:
            passed.add(one.digest)
            one = self.earlier.get(one.digest)
            if one is not None and one.place.content not in self.known:
                return RequestedDocument(content=place.content, part=place.part, base=one.place.content)
        return RequestedDocument(content=place.content, part=place.part)

    def _fetch(self, places: Sequence[RequestedDocument]) -> list[Any]:
        """Request the documents at `places` in order; return as many as fit into one answer, at least one."""
        try:
            return first_documents(self.transport, self.project_url, places, keep_blocks=True)
        except Invalid as error:
            if error.code != OF_UNKNOWN_FIELDS or all(one.base is None for one in places):
                raise
            self.differences = False
            whole = [RequestedDocument(content=one.content, part=one.part) for one in places]
            return first_documents(self.transport, self.project_url, whole, keep_blocks=True)

    def _ask(self, request: ContentsRequest) -> dict[str, Any]:
        return request_contents(self.transport, self.project_url, request, keep_blocks=True)


def _files_in(document: Mapping[str, Any]) -> set[str]:
    return set(references_of(str(document.get("schema")), document)[1].values())
