"""Archives of datasets: one file with a version, all versions before it, and everything that they contain."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tarfile import is_tarfile
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol

from marey_client.archives.documents import CheckContents, DocumentWriter, EarlierDocument
from marey_client.archives.receiving import require_receivable
from marey_client.errors import ArchiveInUse, BadRequest, NothingToArchive, NotReplaced, UnexpectedAnswer
from marey_client.progress import OnProgress
from marey_schemas.datasets.commits import TIME_OF_COMMIT, Commit, Entry
from marey_schemas.datasets.contents import (
    MOST_CHECKED,
    ExportCheck,
    ExportPermission,
    PartOfContent,
)
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_schemas.sizes import batched
from marey_versions.archive.checking import check_archive
from marey_versions.archive.members import ArchiveMember, BadArchive, MemberKind
from marey_versions.archive.reading import Archive
from marey_versions.archive.writing import ArchiveWriter
from marey_versions.records import CommitRecord, revision_content

if TYPE_CHECKING:
    from marey_client.transport import Transport
    from marey_schemas.datasets.differences import DatasetDifference

MOST_LISTED = 10_000
"""Greatest number of differing entries in one request; if two versions differ in more, all their entries are listed."""


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
        """Return the commit that a version (a branch, a tag or a digest) names."""

    def log(self, version: str) -> Iterator[Commit]:
        """List a version and the versions before it; of the parents of a merge, only the first is followed."""

    def entries(self, version: str) -> Iterator[Entry]:
        """List the entries of a version."""

    def difference(self, before: str, after: str, *, limit: int) -> DatasetDifference:
        """Return the entries that differ between two versions."""


def write_archive(
    dataset: DatasetReader,
    version: str,
    path: Path,
    on_progress: OnProgress,
    *,
    since: Sequence[str] = (),
    check: CheckContents,
) -> Commit:
    """Write an archive of a version and check it; the versions `since` and all versions before them are left out.

    Before the documents of revisions are read, `check` is called with the content digests of these revisions, and may
    raise an error. An interrupted call leaves a file whose name ends in `.part`; the next call with the same arguments
    continues it. Raises `ArchiveInUse` if another process is writing the file, `NotReplaced` if a file of this name
    exists and is not an archive, and `NothingToArchive` if no version is left.
    """
    if path.is_file() and path.stat().st_size and not is_tarfile(path):
        raise NotReplaced(f"{path} exists and is not an archive, so it is not replaced; choose another name")
    head = dataset.at(version)
    bases = [dataset.at(one) for one in since]
    part = path.with_name(f"{path.name}.{short_name(head.digest, [one.digest for one in bases])}.part")

    def fill(writer: ArchiveWriter) -> None:
        before: dict[str, Commit] = {}
        for base in bases:
            before = _history(dataset, base, before)
        commits = [one for one in _history(dataset, head, before).values() if one.digest not in before]
        if not commits:
            raise NothingToArchive(
                f"there is nothing to archive: the versions to leave out include {head.digest}; leave out only "
                "earlier versions"
            )
        documents = _documents(dataset, writer, part.parent, on_progress, check, differences=False)
        _ArchiveInProgress(dataset, documents, to_send=False).run(head, commits)

    _write(part, path, fill, on_progress)
    return head


def write_transfer(
    dataset: DatasetReader, commits: Sequence[Commit], path: Path, on_progress: OnProgress, *, differences: bool
) -> None:
    """Write and check an archive of `commits`, newest first, for a server that has all commits before them.

    With `differences`, arrays may be replaced by their differences from arrays of the commits before them; then only
    this server can read the archive. Continues after an interruption as `write_archive` does. Raises `LargeCommit`,
    before documents are read, if a commit has more changes than servers accept. Consents are not checked.
    """

    def fill(writer: ArchiveWriter) -> None:
        documents = _documents(dataset, writer, path.parent, on_progress, _accept, differences=differences)
        _ArchiveInProgress(dataset, documents, to_send=True).run(commits[0], commits)

    _write(path.with_name(f"{path.name}.part"), path, fill, on_progress)


def _accept(_contents: Sequence[str]) -> None:
    """Do nothing: accept revisions without a check of the consents."""


def _documents(
    dataset: DatasetReader,
    writer: ArchiveWriter,
    folder: Path,
    on_progress: OnProgress,
    check: CheckContents,
    *,
    differences: bool,
) -> DocumentWriter:
    return DocumentWriter(dataset.transport, dataset.project_url, writer, folder, on_progress, check, differences)


def _write(part: Path, path: Path, fill: Callable[[ArchiveWriter], None], on_progress: OnProgress) -> None:
    """Write and check the archive `path`, which has the name `part` until it is complete; `fill` adds its members."""
    part.parent.mkdir(parents=True, exist_ok=True)
    with _opened(part) as file:
        fill(ArchiveWriter(file))
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


def check_consents(dataset: DatasetReader, reason: str | None, contents: Sequence[str]) -> frozenset[str]:
    """Ask the server whether revisions, given by content digest, may be exported.

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

    `head` is the digest of the archive's newest commit, and `bases` are the digests of the commits that the archive
    leaves out.
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
    """Return whether the file at `path` is the opened `file`; False if there is no file at `path`."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _history(dataset: DatasetReader, head: Commit, known: Mapping[str, Commit]) -> dict[str, Commit]:
    """Read the commit `head` and its ancestors, back to the commits `known`; return the read commits and `known`."""
    found = dict(known)
    waiting = [head.digest]
    while waiting:
        start = waiting.pop()
        if start in found:
            continue
        for commit in dataset.log(start):
            if commit.digest in found:
                break
            found[commit.digest] = commit
            waiting += commit.parents[1:]
    return found


@dataclass
class _ArchiveInProgress:
    """Archive while it is written: the commits to write, and the documents that are in it already."""

    dataset: DatasetReader
    documents: DocumentWriter
    to_send: bool
    """Whether the archive must be importable; then a commit with more changes than servers accept is an error."""

    def run(self, head: Commit, commits: Sequence[Commit]) -> None:
        """Write the commits, of which `head` is the newest; parents that are not among them become the base."""
        base = {parent for one in commits for parent in one.parents} - {one.digest for one in commits}
        for done, commit in enumerate(commits):
            self.documents.on_progress("reading versions", done, len(commits))
            self._add_commit(commit, unchanged=bool(base))
        self.documents.run()
        self.documents.writer.finish(self.dataset.name, head.digest, sorted(base))

    def _add_commit(self, commit: Commit, *, unchanged: bool) -> None:
        """Add a commit and its changes to the archive, and record the revisions of the changed entries.

        If `unchanged` is true, documents that an entry already had in the first parent of the commit are not added; the
        list of changes names them as unchanged.
        """
        at = commit.at.strftime(TIME_OF_COMMIT)
        record = CommitRecord(commit.tree, commit.parents, commit.author, commit.message, at)
        if record.digest != commit.digest:
            raise UnexpectedAnswer(
                f"the server's commit {commit.digest} does not match its digest; `marey db fsck` on the server finds "
                "damaged data"
            )
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
        writer = self.documents.writer
        writer.add(ArchiveMember(MemberKind.CHANGES, commit.digest), b"".join(lines))
        writer.add(ArchiveMember(MemberKind.COMMIT, commit.digest), canonical_json(record.document))

    def _note(self, entry: Entry, earlier: Entry | None) -> None:
        """Record the revision of an entry, and the addresses of its documents.

        Documents that are also in `earlier`, the entry before the commit, are left out.
        """
        content = _content(entry)
        self.documents.known.add(content)
        for part, digest in entry.parts.items():
            before = None if earlier is None else earlier.parts.get(part)
            if digest != before:
                self.documents.documents.setdefault(digest, PartOfContent(content=content, part=part))
            if earlier is not None and before is not None and before != digest:
                place = PartOfContent(content=_content(earlier), part=part)
                self.documents.earlier[digest] = EarlierDocument(before, place)

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
        """Return the entries that differ between two versions; None if one answer cannot contain all of them."""
        try:
            found = self.dataset.difference(before, after, limit=MOST_LISTED)
        except BadRequest as error:
            if error.code != "large-difference":
                raise
            return None
        return found if found.complete else None


class _EntryPair(NamedTuple):
    """State of an entry after a commit and before it; None if the entry does not exist then."""

    after: Entry | None
    before: Entry | None

    @property
    def unchanged(self) -> dict[str, str]:
        """Names of the parts that did not change, each with the content digest of the revision before the commit.

        Empty if the commit added or removed the entry.
        """
        if self.after is None or self.before is None:
            return {}
        parts = self.after.parts.items() & self.before.parts.items()
        return {part: _content(self.before) for part, _ in parts}


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
