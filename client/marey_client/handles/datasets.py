"""Datasets of a project, and versions that come from archives and other datasets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from marey_client.arguments import checked, checks_arguments
from marey_client.errors import Conflict, Invalid, NotFound
from marey_client.handles.versions import DatasetHandle
from marey_client.paging import pages
from marey_client.progress import OnProgress, ignore_progress
from marey_client.transport import Transport, named_path, sends_nothing
from marey_schemas.datasets.commits import Commit
from marey_schemas.datasets.naming import MAIN, Dataset, DatasetCreate, Ref, RefKind

if TYPE_CHECKING:
    from marey_versions.archive.reading import Archive


class ImportedVersion(NamedTuple):
    """Version that was imported from an archive or copied from another dataset."""

    commit: Commit
    branch: str
    """The branch that was to move to the version."""
    moved: bool
    """Whether the branch is at the imported version now; if not, the branch has other versions, and can be merged."""
    tag: str | None = None
    """The tag that was copied with the version, or None."""


@checks_arguments
@dataclass(frozen=True)
class Datasets:
    """Datasets of a project, and imports of versions into them."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the datasets, relative to the API's root."""
        return f"/projects/{self.project}/datasets"

    def create(self, name: str, *, collection: str | None = None, description: str = "") -> DatasetHandle:
        """Create a dataset, whose commits record the content of the folder `collection` if one is given."""
        request = checked(DatasetCreate, name=name, collection=collection, description=description)
        self.transport.post(Dataset, self.url, request)
        return self.at(name)

    def list(self) -> Iterator[Dataset]:
        """List the datasets by name."""
        return pages(self.transport, Dataset, self.url)

    def import_archive(
        self, path: str | Path, name: str, *, into: str = MAIN, on_progress: OnProgress = ignore_progress
    ) -> ImportedVersion:
        """Check an archive, and record its versions in a dataset, which is created if it does not exist.

        The versions keep their digests, and no folder is changed. The branch `into` is created if it does not exist. If
        the newest commit of the branch is an ancestor of the newest imported version, the branch moves to this version.
        Otherwise, the branch does not move, and the caller can merge the version into the branch.

        Raises `marey_versions.archive.members.BadArchive`, which names the member that was changed or is missing, and
        `EarlierVersionsMissing` if the archive builds on a version that the dataset does not have. Raises `LargeCommit`
        if a version changes more entries than an imported version may change.
        """
        from marey_client.archives.receiving import require_base
        from marey_versions.archive.checking import check_archive
        from marey_versions.archive.reading import Archive

        with Path(path).open("rb") as file:
            archive = Archive(file)
            check_archive(archive, lambda done, of: on_progress("checking", done, of))
            handle = self.at(name)
            try:
                handle.read()
            except NotFound:
                require_base(archive, lambda _commit: False)
                handle = self.create(name, collection=name)
            return _receive(handle, archive, into, handle.find_ref(into), handle.has, on_progress)

    def pull(
        self,
        source: DatasetHandle,
        name: str,
        version: str = MAIN,
        *,
        into: str | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> ImportedVersion:
        """Copy a version of another dataset, and all versions before it, into the dataset `name` of this project.

        `source` may be on another server. The dataset `name` is created if it does not exist, and only what this
        dataset lacks is copied. The next call continues an interrupted copy. The branch `into` moves as in
        `import_archive`; by default, it is the branch that `version` names, or `main` if `version` is not a branch. If
        `version` is a tag, the tag is created too, unless a branch or tag of this name exists.
        """
        from marey_client.archives.transfers import copy_missing, find_missing

        head, named = source.at(version), source.find_ref(version)
        branch = into or (version if named is not None and named.kind is RefKind.BRANCH else MAIN)
        target = self.at(name)
        ref = target.find_ref(branch)
        if ref is None:
            self._create_unless_exists(name)
            ref = target.find_ref(branch)
        has = _known_commits(target, ref)
        missing = find_missing(source, head, has)
        if missing.commits:
            made = copy_missing(
                source, missing, lambda archive: _receive(target, archive, branch, ref, has, on_progress), on_progress
            )
        else:
            made = _forward(target, branch, target.at(head.digest))
        if named is None or named.kind is not RefKind.TAG:
            return made
        tag = target.find_ref(named.name) or target.create_tag(named.name, head.digest)
        return made._replace(tag=tag.name if tag.kind is RefKind.TAG and tag.commit == head.digest else None)

    def _create_unless_exists(self, name: str) -> None:
        try:
            self.at(name).read()
        except NotFound:
            self.create(name, collection=name)

    @sends_nothing
    def at(self, name: str) -> DatasetHandle:
        """Return a handle of the dataset with this name; no request is sent."""
        return DatasetHandle(self.transport, named_path(self.url, name))


def _known_commits(dataset: DatasetHandle, ref: Ref | None) -> Callable[[str], bool]:
    """Return a function that returns whether the dataset has a commit, and asks the server once for each commit.

    For the newest commit of the branch `ref`, no request is sent.
    """
    ask = cache(dataset.has)
    return lambda digest: (ref is not None and ref.commit == digest) or ask(digest)


def _receive(
    dataset: DatasetHandle,
    archive: Archive,
    into: str,
    ref: Ref | None,
    has: Callable[[str], bool],
    on_progress: OnProgress,
) -> ImportedVersion:
    """Record the versions of an archive without checking the archive; move the branch `into` to the newest version.

    `ref` is the branch `into`, or None if there is no such branch or tag. The branch does not move if its newest commit
    is not an ancestor of the newest version.
    """
    from marey_client.archives.receiving import send_versions

    empty = ref is not None and ref.commit is None
    made = send_versions(dataset, archive, on_progress, has, begins=into if empty else None)
    if ref is not None and ref.kind is RefKind.BRANCH and ref.commit in archive.manifest.base:
        with suppress(Conflict):  # the branch has moved, or is protected
            merged = dataset.merge(made.digest, into=into, expected=ref.commit)
            if merged.commit is not None and merged.commit.digest == made.digest:
                return ImportedVersion(made, into, True)
    return _forward(dataset, into, made)


def _forward(dataset: DatasetHandle, branch: str, commit: Commit) -> ImportedVersion:
    """Move a branch to the given commit if this commit is a descendant of the branch's newest commit.

    A branch that does not exist is created. The field `moved` of the result is true if the branch is at the commit now.
    """
    ref = dataset.find_ref(branch)
    if ref is None:
        dataset.create_branch(branch, commit.digest)
    elif ref.commit is None:
        dataset.move_branch(branch, commit.digest, expected_rev=ref.rev)
    elif ref.commit != commit.digest:
        return ImportedVersion(commit, branch, _fast_forward(dataset, branch, commit.digest))
    return ImportedVersion(commit, branch, True)


def _fast_forward(dataset: DatasetHandle, branch: str, commit: str) -> bool:
    """Move a branch to the given commit if this commit is a descendant of the branch's newest commit.

    The branch must have another commit already. Returns whether the branch is at the given commit now.
    """
    try:
        preview = dataset.merge(commit, into=branch, preview=True)
    except (Conflict, Invalid):  # nothing to merge, or no single common version: a person must decide
        return False
    if preview.base != preview.ours:
        return False
    merged = dataset.merge(commit, into=branch, expected=preview.ours)
    return merged.commit is not None and merged.commit.digest == commit
