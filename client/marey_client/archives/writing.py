"""Archives of datasets: one file with a version, all versions before it, and everything that they contain."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol

from marey_client.archives.contents import first_documents, read_facets, request_contents
from marey_client.archives.receiving import require_receivable
from marey_client.blobs import Blobs
from marey_client.errors import ArchiveInUse, BadRequest, NothingToArchive, UnexpectedAnswer
from marey_client.progress import OnProgress
from marey_schemas.datasets.commits import TIME_OF_COMMIT, Commit, Entry
from marey_schemas.datasets.contents import (
    MOST_CHECKED,
    MOST_CONTENTS,
    ContentsRequest,
    ExportCheck,
    ExportPermission,
    PartOfContent,
)
from marey_schemas.documents.blob_references import references_of
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json, detach_arrays
from marey_schemas.sizes import batched
from marey_versions.archive.checking import check_archive
from marey_versions.archive.members import ArchiveMember, BadArchive, MemberKind
from marey_versions.archive.reading import Archive
from marey_versions.archive.writing import ArchiveWriter
from marey_versions.records import CommitRecord, contents_in, revision_content
from marey_versions.tree.chunks import digest_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from marey_client.transport import Transport
    from marey_schemas.datasets.differences import DatasetDifference

MOST_LISTED = 10_000
"""Number of differences that are requested at once; versions that differ in more entries are listed whole."""

CheckContents = Callable[[Sequence[str]], object]
"""Function called with content digests of revisions before their documents are read."""


class DatasetReader(Protocol):
    """Methods of `DatasetHandle` that are needed to write an archive."""

    @property
    def transport(self) -> Transport:
        """The connections to the server."""

    @property
    def project_url(self) -> str:
        """The path of the project, relative to the API's root."""

    @property
    def name(self) -> str:
        """The name of the dataset."""

    def at(self, version: str) -> Commit:
        """Return the commit that a version names."""

    def log(self, version: str) -> Iterator[Commit]:
        """List a version and the versions before it; of the parents of a merge, only the first is followed."""

    def entries(self, version: str) -> Iterator[Entry]:
        """List the entries of a version."""

    def difference(self, before: str, after: str, *, limit: int) -> DatasetDifference:
        """Return the entries that differ in two versions."""


def write_archive(
    dataset: DatasetReader,
    version: str,
    path: Path,
    on_progress: OnProgress,
    *,
    since: Sequence[str] = (),
    check: CheckContents,
    to_send: bool = False,
) -> Commit:
    """Write an archive of a version and check it; the versions `since` and all versions before them are left out.

    Before the documents of revisions are read, `check` is called with the content digests of these revisions, and may
    raise an error. An interrupted call leaves a file whose name ends in `.part`; the next call with the same arguments
    continues it. Raises `ArchiveInUse` if another process is writing the file, and `NothingToArchive` if no version is
    left. With `to_send`, also raises `LargeCommit`, before documents are read, if one of the commits has more changes
    than servers accept.
    """
    head = dataset.at(version)
    bases = [dataset.at(one) for one in since]
    part = path.with_name(f"{path.name}.{short_name(head.digest, [one.digest for one in bases])}.part")
    part.parent.mkdir(parents=True, exist_ok=True)
    with _opened(part) as file:
        _Making(dataset, ArchiveWriter(file), part.parent, on_progress, check, to_send).run(head, bases)
        try:
            check_archive(Archive(file), lambda done, of: on_progress("checking", done, of))
        except BadArchive as error:
            part.unlink()
            raise UnexpectedAnswer(
                f"the archive was damaged while it was written; repeat the command: {error}"
            ) from error
        file.flush()
        os.fsync(file.fileno())
        part.replace(path)  # before the file is unlocked, so that no other process changes the finished archive
    return head


def check_consents(dataset: DatasetReader, reason: str | None, contents: Sequence[str]) -> frozenset[str]:
    """Check that revisions, given by content digest, may be exported.

    Returns the ids of the items whose consent has ended. Raises `Conflict` if there are such items and `reason` is
    None. A `reason` permits the export of these items; the server records the reason.
    """
    ended: set[str] = set()
    for some in batched(contents, MOST_CHECKED):
        request = ExportCheck(contents=tuple(some), allow_expired_consent=reason is not None, consent_reason=reason)
        url = f"{dataset.project_url}/datasets/{dataset.name}/export-checks"
        ended.update(dataset.transport.post(ExportPermission, url, request).ended)
    return frozenset(ended)


def short_name(head: str, bases: Iterable[str]) -> str:
    """Return a text of 32 characters, for file names, that identifies the content of an archive.

    `head` is the digest of the archive's newest commit, and `bases` are those of the commits that it leaves out.
    """
    return digest_of("\n".join([head, *sorted(set(bases))]).encode()).removeprefix("sha256:")[:32]


@contextmanager
def _opened(part: Path) -> Iterator[BinaryIO]:
    """Open an unfinished archive, and keep other processes from writing it until it is closed."""
    while True:
        with os.fdopen(os.open(part, os.O_RDWR | os.O_CREAT, 0o666), "r+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ArchiveInUse(f"another process is writing {part}; wait until that process has ended") from error
            if _is_at(part, file):
                yield file
                return
            # Another process finished the archive between the two steps, so this file is no longer the unfinished one.


def _is_at(path: Path, file: BinaryIO) -> bool:
    """Return whether the path leads to this opened file, and not to another file or to none."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


@dataclass
class _Making:
    """Archive that is being written."""

    dataset: DatasetReader
    writer: ArchiveWriter
    folder: Path
    """Folder in whose file system files are kept, without a name, until they are in the archive."""
    on_progress: OnProgress
    check: CheckContents
    to_send: bool
    """Whether the archive must be importable; then a commit with more changes than servers accept is an error."""
    known: set[str] = field(default_factory=set)
    """Content digests of the revisions that the archive has, or will have."""
    documents: dict[str, PartOfContent] = field(default_factory=dict)
    """Address on the server of each document of an entry, by the digest of the document."""
    earlier: dict[str, PartOfContent] = field(default_factory=dict)
    """Address of the earlier document, by the digest of the document that replaced it."""

    def run(self, head: Commit, bases: Sequence[Commit]) -> None:
        before: dict[str, Commit] = {}
        for base in bases:
            before = self._history(base, before)
        commits = [one for one in self._history(head, before).values() if one.digest not in before]
        if not commits:
            raise NothingToArchive(f"there is nothing to archive: the versions to leave out include {head.digest}")
        for done, commit in enumerate(commits):
            self.on_progress("reading versions", done, len(commits))
            self._add_commit(commit, unchanged=bool(bases))
        self.check(sorted(self.known))
        self._add_documents(self.documents)
        self._add_facets()
        parents = {parent for commit in commits for parent in commit.parents}
        self.writer.finish(self.dataset.name, head.digest, sorted(parents & before.keys()))

    # -- versions ------------------------------------------------------------------------------------------------------

    def _history(self, head: Commit, known: Mapping[str, Commit]) -> dict[str, Commit]:
        """Read the commit `head` and its ancestors, back to the commits `known`; return all of them by digest."""
        found = dict(known)
        waiting = [head.digest]
        while waiting:
            start = waiting.pop()
            if start in found:
                continue
            for commit in self.dataset.log(start):
                if commit.digest in found:
                    break
                found[commit.digest] = commit
                waiting += commit.parents[1:]
        return found

    def _add_commit(self, commit: Commit, *, unchanged: bool) -> None:
        """Add a commit and its changes to the archive, and note the revisions of the changed entries.

        If `unchanged` is true, documents that an entry already had in the first parent of the commit are not added; the
        list of changes names them as unchanged.
        """
        at = commit.at.strftime(TIME_OF_COMMIT)
        record = CommitRecord(commit.tree, commit.parents, commit.author, commit.message, at)
        if record.digest != commit.digest:
            raise UnexpectedAnswer(f"the server's commit {commit.digest} does not match its digest")
        changes = self._changes(commit)
        if self.to_send:
            require_receivable(commit.digest, len(changes))
        lines = []
        for place, change in sorted(changes.items()):
            earlier = change.before if unchanged else None
            line = _line(place, change.after, {} if earlier is None else change.unchanged)
            lines.append(canonical_json(line) + b"\n")
            if change.after is not None:
                self._note(change.after, earlier)
        self.writer.add(ArchiveMember(MemberKind.CHANGES, commit.digest), b"".join(lines))
        self.writer.add(ArchiveMember(MemberKind.COMMIT, commit.digest), canonical_json(record.document))

    def _note(self, entry: Entry, earlier: Entry | None) -> None:
        """Record the revision of an entry, and the addresses of its documents.

        Documents that are also in `earlier`, the entry before the commit, are left out.
        """
        content = _content(entry)
        self.known.add(content)
        for part, digest in entry.parts.items():
            before = None if earlier is None else earlier.parts.get(part)
            if digest != before:
                self.documents.setdefault(digest, PartOfContent(content=content, part=part))
            if earlier is not None and before not in (None, digest):
                self.earlier[digest] = PartOfContent(content=_content(earlier), part=part)

    def _changes(self, commit: Commit) -> dict[tuple[str, str], _EntryPair]:
        """Return the entries that differ between a commit and its first parent, by path and kind."""
        if not commit.parents:
            return {_place(one): _EntryPair(one, None) for one in self.dataset.entries(commit.digest)}
        found = self._difference(commit.parents[0], commit.digest)
        if found is not None:
            gone = {_place(one.before): _EntryPair(None, None) for one in found.entries if one.before is not None}
            now = {
                _place(one.after): _EntryPair(one.after, one.before) for one in found.entries if one.after is not None
            }
            return {**gone, **now}
        before, after = (
            {_place(one): one for one in self.dataset.entries(version)}
            for version in (commit.parents[0], commit.digest)
        )
        both = {place: _EntryPair(after.get(place), before.get(place)) for place in before.keys() | after.keys()}
        return {place: one for place, one in both.items() if _line(place, one.before) != _line(place, one.after)}

    def _difference(self, before: str, after: str) -> DatasetDifference | None:
        """Return the entries that differ in two versions; None if they are too many for one answer of the server."""
        try:
            found = self.dataset.difference(before, after, limit=MOST_LISTED)
        except BadRequest as error:
            if error.code != "large-difference":
                raise
            return None
        return found if found.complete else None

    # -- content -------------------------------------------------------------------------------------------------------

    def _add_documents(self, wanted: Mapping[str, PartOfContent]) -> None:
        """Add documents, given by digest, to the archive.

        New revisions, arrays and files to which a document refers are added before the document.
        """
        digests = [one for one in wanted if ArchiveMember(MemberKind.DOCUMENT, one) not in self.writer]
        total = len(digests)
        while digests:
            trees = self._fetch([wanted[digest] for digest in digests[:MOST_CONTENTS]])
            together = dict(zip(digests, trees, strict=False))
            self._add_together(together)
            digests = digests[len(together) :]
            self.on_progress("reading documents", total - len(digests), total)

    def _add_together(self, trees: Mapping[str, Any]) -> None:
        arrays: dict[str, EncodedArray] = {}

        def keep(name: str, array: NDArray[Any] | EncodedArray) -> None:
            arrays[name] = array if isinstance(array, EncodedArray) else EncodedArray.of(array)

        bodies = {digest: detach_arrays(tree, keep) for digest, tree in trees.items()}
        self._add_revisions({one for body in bodies.values() for one in contents_in(body)} - self.known)
        for name, array in arrays.items():
            self.writer.add(ArchiveMember(MemberKind.ARRAY, name), array.data)
        for digest, body in bodies.items():
            data = canonical_json(body)
            if digest_of(data) != digest:
                raise UnexpectedAnswer(f"the server's document {digest} does not match its digest")
            for file in self._files(digest, body):
                self._add_file(ArchiveMember(MemberKind.FILE, file))
            self.writer.add(ArchiveMember(MemberKind.DOCUMENT, digest), data)

    def _files(self, digest: str, body: Any) -> set[str]:
        """Return the digests of the files that a document names, without the files that its earlier version named."""
        named = _files_in(body)
        if named and digest in self.earlier:
            (before,) = self._fetch([self.earlier[digest]])
            named -= _files_in(before)
        return named

    def _add_revisions(self, contents: Iterable[str]) -> None:
        """Add revisions, given by content digest, and their documents; other documents refer to these revisions."""
        waiting = sorted(contents)
        self.known.update(waiting)
        self.check(waiting)
        for some in batched(waiting, MOST_CONTENTS):
            found = self._ask(ContentsRequest(revisions=tuple(some)))["revisions"]
            for content, one in zip(some, found, strict=True):
                if one is None:
                    raise UnexpectedAnswer(f"a document refers to the content {content}, which the project lacks")
                self._add_documents(
                    {digest: PartOfContent(content=content, part=part) for part, digest in one["parts"].items()}
                )
                self.writer.add(ArchiveMember(MemberKind.REVISION, content), canonical_json(one))

    def _add_facets(self) -> None:
        """Add the facets of all revisions, which jobs may have published after the revisions were committed.

        Each member has those of a few revisions, because readers refuse members of more than `MOST_BYTES`.
        """
        for some in batched(sorted(self.known), MOST_CONTENTS):
            if facets := read_facets(self.dataset.transport, self.dataset.project_url, some):
                data = canonical_json(facets)
                self.writer.add(ArchiveMember(MemberKind.FACETS, digest_of(data)), data)

    def _add_file(self, member: ArchiveMember) -> None:
        if member in self.writer:
            return
        with tempfile.TemporaryFile(dir=self.folder) as file:  # without a name, so that a killed process leaves none
            Blobs(self.dataset.transport).fetch_into(member.digest, file)
            size_bytes = file.tell()
            file.seek(0)
            self.writer.add_stream(member, file, size_bytes)

    def _fetch(self, places: Sequence[PartOfContent]) -> list[Any]:
        """Request the documents at `places` in order; return as many as fit into one answer, at least one."""
        return first_documents(self.dataset.transport, self.dataset.project_url, places, keep_blocks=True)

    def _ask(self, request: ContentsRequest) -> dict[str, Any]:
        return request_contents(self.dataset.transport, self.dataset.project_url, request, keep_blocks=True)


class _EntryPair(NamedTuple):
    """State of an entry after and before a commit; None where the entry does not exist."""

    after: Entry | None
    before: Entry | None

    @property
    def unchanged(self) -> dict[str, str]:
        """The content digest of the entry's revision before the commit, by the name of each unchanged part."""
        if self.after is None or self.before is None:
            return {}
        parts = self.after.parts.items() & self.before.parts.items()
        return {part: _content(self.before) for part, _ in parts}


def _files_in(document: Mapping[str, Any]) -> set[str]:
    return set(references_of(str(document.get("schema")), document)[1].values())


def _content(entry: Entry) -> str:
    return revision_content(entry.kind.value, entry.parts)


def _place(entry: Entry) -> tuple[str, str]:
    return entry.path, entry.kind.value


def _line(place: tuple[str, str], entry: Entry | None, unchanged: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the JSON object that describes a changed entry in the archive's list of changes.

    `place` is the path and the kind of the entry. `entry` is the entry after the change; None if it was removed.
    `unchanged` contains the names of the parts that did not change, and maps each name to the content digest of the
    entry's revision before the change.
    """
    path, kind = place
    if entry is None:
        return {"path": path, "kind": kind, "removed": True}
    line = {"path": path, "kind": kind, "parts": entry.parts, "tags": sorted(entry.tags)}
    return {**line, "unchanged": dict(unchanged)} if unchanged else line
