"""Check of a whole archive: that every member is intact, and that no member is missing or superfluous."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from marey_schemas.documents.blob_references import references_of
from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import EncodedArray
from marey_versions.archive.members import ArchiveMember, BadArchive, MemberKind
from marey_versions.archive.reading import Archive
from marey_versions.records import contents_in, path_and_kind, revision_content

OnProgress = Callable[[int, int], None]
"""Function called with the number of members that were checked, and the number of all members."""


@dataclass
class _Check:
    """State of the check of an archive."""

    archive: Archive
    on_progress: OnProgress
    checked: set[ArchiveMember] = field(default_factory=set)
    known: set[str] = field(default_factory=set)
    """Content digests of the revisions that were found in entries and in members of the archive."""
    documents: set[str] = field(default_factory=set)
    """Digests of documents that were found, and that must still be checked."""

    def run(self) -> None:
        for digest, _ in self.archive.history():
            self._mark(ArchiveMember(MemberKind.COMMIT, digest))
            self._changes_of(digest)
        if not self.archive.manifest.base:
            self.archive.versions()
        while self.documents:
            self._document(self.documents.pop())
        self._facets()
        if left := sorted(self.archive.members.keys() - self.checked):
            raise BadArchive(
                f"{left[0].name}: no version in the archive contains this member, so it was added later; export the "
                "archive again"
            )

    def _changes_of(self, commit: str) -> None:
        self._mark(ArchiveMember(MemberKind.CHANGES, commit))
        for key, (value, unchanged) in self.archive.changes(commit).items():
            if value is not None:
                if unchanged and not self.archive.manifest.base:
                    raise BadArchive(
                        f"{ArchiveMember(MemberKind.CHANGES, commit).name}: the member refers to an earlier archive, "
                        "but this archive contains the whole history, so it was altered; export it again"
                    )
                documents = [digest for part, digest in value["parts"].items() if part not in unchanged]
                self._revision(revision_content(path_and_kind(key)[1], value["parts"]), documents)

    def _revision(self, content: str, documents: Iterable[str]) -> None:
        self.known.add(content)
        self.documents.update(one for one in documents if ArchiveMember(MemberKind.DOCUMENT, one) not in self.checked)

    def _document(self, digest: str) -> None:
        tree = self.archive.tree(MemberKind.DOCUMENT, digest)
        self._mark(ArchiveMember(MemberKind.DOCUMENT, digest))
        arrays, files = references_of(str(tree.get("schema")) if isinstance(tree, dict) else "", tree)
        differences = self._differences(digest)
        for leaf in arrays.values():
            self._array(leaf, digest, differences.get(str(leaf["content"])))
        for one in set(files.values()):
            self._file(one)
        for content in set(contents_in(tree)) - self.known:
            self._referenced(content)

    def _referenced(self, content: str) -> None:
        member = ArchiveMember(MemberKind.REVISION, content)
        found = self.archive.tree(MemberKind.REVISION, content)
        self._mark(member)
        if not isinstance(found, dict) or not isinstance(found.get("parts"), dict):
            raise BadArchive(f"{member.name}: the content does not describe a revision; export the archive again")
        self._revision(content, found["parts"].values())

    def _array(self, leaf: Mapping[str, Any], document: str, difference: ArrayDifference | None) -> None:
        member = ArchiveMember(MemberKind.ARRAY, str(leaf["content"]))
        if difference is not None:
            self._require_size(leaf, document, difference, ArchiveMember(MemberKind.DIFFERENCES, document))
            if member not in self.archive.members:
                return
        if member not in self.checked:
            self._require_size(leaf, document, self.archive.array(member.digest), member)
            self._mark(member)

    def _differences(self, document: str) -> dict[str, ArrayDifference]:
        found = self.archive.differences(document)
        if found:
            self._mark(ArchiveMember(MemberKind.DIFFERENCES, document))
        return found

    def _require_size(
        self, leaf: Mapping[str, Any], document: str, array: EncodedArray | ArrayDifference, member: ArchiveMember
    ) -> None:
        """Raise `BadArchive` if a document states another dtype or shape than the member with the array."""
        if leaf["dtype"] != array.dtype or leaf["shape"] != list(array.shape):
            name = ArchiveMember(MemberKind.DOCUMENT, document).name
            raise BadArchive(
                f"{name}: the dtype or shape given here differs from that of the array {member.name}; export the "
                "archive again"
            )

    def _file(self, digest: str) -> None:
        member = ArchiveMember(MemberKind.FILE, digest)
        if self.archive.manifest.base and member not in self.archive.members:
            return  # an earlier version has it
        if member not in self.checked:
            for _ in self.archive.file(digest):
                pass
            self._mark(member)

    def _facets(self) -> None:
        """Check that all facets belong to revisions that the archive contains or refers to."""
        strangers = sorted(self.archive.facets().keys() - self.known)
        for member in [one for one in self.archive.members if one.kind is MemberKind.FACETS]:
            if strangers:
                raise BadArchive(
                    f"{member.name}: no version in the archive contains the revision {strangers[0]}, whose facets the "
                    "member gives; copy or export the archive again"
                )
            self._mark(member)

    def _mark(self, member: ArchiveMember) -> None:
        self.checked.add(member)
        self.on_progress(len(self.checked), len(self.archive.members))


def check_archive(archive: Archive, on_progress: OnProgress = lambda _done, _all: None) -> None:
    """Check that an archive contains everything to which its commits refer, unchanged, and nothing else.

    To compare the entries of a version with the digest in its commit, all earlier versions are needed. So if an archive
    has only the later part of a history, these digests are compared only when the server imports the archive. Raises
    `BadArchive`, which names the faulty member.
    """
    _Check(archive, on_progress).run()
