"""Datasets of a project: commits, branches, tags and differences of versions."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, TypedDict, Unpack

from marey_client.access import ANY_STATE
from marey_client.errors import NotFound, RequestFailed
from marey_client.handles.bisections import Bisection, IsBad, OnStep, bisect, read_range
from marey_client.handles.proposals import Proposals
from marey_client.paging import pages
from marey_client.progress import OnProgress, ignore_progress
from marey_client.transport import Params, Transport, as_json, read_model
from marey_schemas.datasets.commits import Commit, CommitCreate, Entry, EntryChange, EntryOrigins
from marey_schemas.datasets.differences import DatasetDifference, ListedCommit
from marey_schemas.datasets.merges import (
    CheckoutAnswer,
    CheckoutRequest,
    MergeAnswer,
    MergeRequest,
    PickRequest,
    Resolution,
)
from marey_schemas.datasets.naming import MAIN, Dataset, DatasetCreate, Ref, RefCreate, RefKind, RefMove
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.formats import DEFAULT_FORMAT
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from marey_client.bridges.files import ExportedVersion
    from marey_versions.archive.reading import Archive


@dataclass(frozen=True)
class Datasets:
    """Datasets of a project."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the resource, relative to the API's root."""
        return f"/projects/{self.project}/datasets"

    def create(self, name: str, *, collection: str | None = None, description: str = "") -> DatasetHandle:
        """Create a dataset, whose commits record the content of the folder `collection` if one is given."""
        request = DatasetCreate(name=name, collection=collection, description=description)
        self.transport.post(Dataset, self.url, request)
        return self.at(name)

    def list(self) -> Iterator[Dataset]:
        """List the datasets by name."""
        return pages(self.transport, Dataset, self.url)

    def import_archive(
        self, path: str | Path, name: str, *, into: str = MAIN, on_progress: OnProgress = ignore_progress
    ) -> ImportedVersion:
        """Check an archive, and record its versions in a dataset, which is created if it does not exist.

        The versions keep their digests, and no folder is changed. The branch `into` is created if it does not exist. It
        moves to the newest imported version if its newest commit is an ancestor of this version. Otherwise it does not
        move, and the caller can merge the version into it.

        Raises `marey_versions.archive.members.BadArchive`, which names the member that was changed or is missing, and
        `EarlierVersionsMissing` if the archive builds on a version that the dataset does not have.
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
            return handle.receive(archive, into=into, on_progress=on_progress)

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

        `source` may be on another server. Only what the dataset `name` lacks is copied; it is created if it does not
        exist. An interrupted copy is continued by the next call. The branch `into`, by default the branch that
        `version` names or `main`, moves as in `import_archive`. If `version` is a tag, the tag is created too, unless a
        branch or tag of this name exists.
        """
        from marey_client.archives.transfers import fetched_versions, find_missing

        head, named = source.at(version), source.find_ref(version)
        target = self._opened_or_created(name)
        branch = into or (version if named is not None and named.kind is RefKind.BRANCH else MAIN)
        missing = find_missing(source, head, target.has)
        if missing.commits:
            with fetched_versions(source, head, missing.bases, on_progress) as archive:
                made = target.receive(archive, into=branch, on_progress=on_progress)
        else:
            made = target.forward(branch, target.at(head.digest))
        if named is None or named.kind is not RefKind.TAG:
            return made
        tag = target.find_ref(named.name) or target.create_tag(named.name, head.digest)
        return made._replace(tag=tag.name if tag.kind is RefKind.TAG and tag.commit == head.digest else None)

    def _opened_or_created(self, name: str) -> DatasetHandle:
        handle = self.at(name)
        try:
            handle.read()
        except NotFound:
            return self.create(name, collection=name)
        return handle

    def at(self, name: str) -> DatasetHandle:
        """Return a handle of the dataset with this name; no request is sent."""
        return DatasetHandle(self.transport, f"{self.url}/{name}")


class PickOptions(TypedDict, total=False):
    """Options of `DatasetHandle.cherry_pick` and `DatasetHandle.revert`."""

    into: str
    """Branch that gets the changes; default: main."""
    parent: Literal[1, 2]
    """For a merge commit: the number of the parent with which it is compared to find its changes."""
    message: str
    """Message of the commit."""
    resolutions: tuple[Resolution, ...]
    """Decisions of conflicts."""
    preview: bool
    """Whether the result is only computed, not recorded."""
    expected: str
    """Commit that must be the newest one of the branch."""


class ImportedVersion(NamedTuple):
    """Version that was imported from an archive or copied from another dataset."""

    commit: Commit
    branch: str
    """The branch that was to have the version."""
    moved: bool
    """Whether the branch is at the version now; if not, it has other versions, and the two can be merged."""
    tag: str | None = None
    """The tag that was copied with the version, or None."""


@dataclass(frozen=True)
class DatasetHandle:
    """Handle of a dataset; requests are sent only by its methods.

    A version is the name of a branch or a tag, or the digest of a commit, of which the first 8 digits are enough. With
    `~n` at its end, it is the version n commits earlier.
    """

    transport: Transport
    url: str

    @property
    def name(self) -> str:
        """The name of the dataset."""
        return self.url.rpartition("/")[2]

    @property
    def project_url(self) -> str:
        """The path of the project, relative to the API's root."""
        return self.url.rpartition("/datasets/")[0]

    def read(self) -> Dataset:
        """Return the dataset."""
        return self.transport.get(Dataset, self.url)

    def delete(self) -> None:
        """Delete the dataset; its items stay."""
        self.transport.send("DELETE", self.url, headers=ANY_STATE)

    @property
    def proposals(self) -> Proposals:
        """The proposals to merge versions into branches of the dataset."""
        return Proposals(self.transport, f"{self.url}/proposals")

    # -- versions ------------------------------------------------------------------------------------------------------

    def commit(
        self,
        message: str,
        *,
        branch: str = MAIN,
        changes: Sequence[EntryChange] | None = None,
        expected: str | None = None,
    ) -> Commit:
        """Record a new version: the content of the dataset's folder, or the newest version with `changes`.

        If the answer is lost, the request is sent again and returns the commit that was made the first time. Raises
        `Conflict` if `expected` is given and is not the newest commit of the branch.
        """
        request = CommitCreate(
            branch=branch,
            message=message,
            changes=None if changes is None else tuple(changes),
            expected=expected,
            write_id=secrets.token_hex(16),
        )
        return self.transport.post(Commit, f"{self.url}/commits", request)

    def log(self, version: str = MAIN, *, path: str = "") -> Iterator[ListedCommit]:
        """List a version and the versions before it, newest first; of a merge, only the first parent is followed.

        With `path`, list only the commits that changed the entry or the folder at this path, with the number of entries
        that each of them added, removed, moved and changed there.
        """
        return pages(self.transport, ListedCommit, f"{self.url}/commits", {"version": version, "path": path})

    def at(self, version: str = MAIN) -> Commit:
        """Return the commit that a version names."""
        return self.transport.get(Commit, f"{self.url}/commits/{version}")

    def has(self, commit: str) -> bool:
        """Return whether the dataset has the commit with this digest."""
        try:
            return self.at(commit).digest == commit
        except NotFound:
            return False

    def entries(self, version: str = MAIN, *, path: str = "") -> Iterator[Entry]:
        """List the entries of a version by path, all or those below a folder."""
        return pages(self.transport, Entry, f"{self.url}/entries", {"version": version, "path": path, "limit": 1000})

    def difference(
        self, before: str = f"{MAIN}~1", after: str = MAIN, *, path: str = "", limit: int = 1000
    ) -> DatasetDifference:
        """Return the entries that differ between two versions, at most `limit` of them.

        With `path`, only the entry or the folder at this path is compared.
        """
        query: Params = {"before": before, "after": after, "path": path, "limit": limit}
        return self.transport.get(DatasetDifference, f"{self.url}/difference", query)

    def merge(
        self,
        version: str,
        *,
        into: str = MAIN,
        message: str = "",
        resolutions: Sequence[Resolution] = (),
        preview: bool = False,
        expected: str | None = None,
    ) -> MergeAnswer:
        """Merge a version into a branch, entry by entry and part by part; with `preview`, only compute the result.

        Annotations that both sides have changed are merged segment by segment.

        Raises `Conflict` with the code `merge-conflicts` if both sides have changed the same part of an entry and
        `resolutions` do not decide it; the `context` of the error then has the fields of `MergeAnswer`.
        """
        request = MergeRequest(
            into=into,
            version=version,
            message=message,
            resolutions=tuple(resolutions),
            preview=preview,
            expected=expected,
            write_id=secrets.token_hex(16),
        )
        return self.transport.post(MergeAnswer, f"{self.url}/merges", request)

    def cherry_pick(self, version: str, **options: Unpack[PickOptions]) -> MergeAnswer:
        """Repeat the changes of one commit on a branch.

        Raises `Conflict` with the code `merge-conflicts` if the branch has changed the same parts.
        """
        return self._pick("cherry-picks", version, options)

    def revert(self, version: str, **options: Unpack[PickOptions]) -> MergeAnswer:
        """Undo the changes of one commit on a branch; later changes stay.

        Raises `Conflict` with the code `merge-conflicts` if later commits have changed the same parts.
        """
        return self._pick("reverts", version, options)

    def _pick(self, resource: str, version: str, options: PickOptions) -> MergeAnswer:
        request = PickRequest(version=version, write_id=secrets.token_hex(16), **options)
        return self.transport.post(MergeAnswer, f"{self.url}/{resource}", request)

    def blame(self, path: str, kind: Kind, version: str = MAIN) -> EntryOrigins:
        """Return the commits that last changed the parts, the path and the tags of an entry."""
        query: Params = {"version": version, "entry": path, "kind": kind}
        return self.transport.get(EntryOrigins, f"{self.url}/blame", query)

    def bisect(
        self,
        good: str,
        bad: str,
        is_bad: IsBad,
        *,
        first_parent: bool = False,
        on_step: OnStep | None = None,
    ) -> Bisection:
        """Find the first bad version among those after `good` that led to `bad`, by halving them again and again.

        `is_bad` is called with the commits of versions to test, first with the two ends. It returns whether the version
        is bad, or None if it cannot be tested. With `first_parent`, only the first parents of merges are followed.
        `ProjectHandle.bisect` tests a metric of the evaluation of each version.

        Raises `CannotBisect` if `good` is not among the versions before `bad`, or if the tests of the two ends do not
        show that `good` is good and `bad` is bad.
        """
        return bisect(read_range(self, good, bad, first_parent=first_parent), is_bad, on_step)

    def check_out(self, version: str = MAIN, *, discard: bool = False) -> CheckoutAnswer:
        """Bring the folder of the dataset to the state of a version.

        Raises `Conflict` if the folder has changes that no commit has recorded, unless `discard` is true.
        """
        request = CheckoutRequest(version=version, discard=discard)
        return self.transport.post(CheckoutAnswer, f"{self.url}/checkout", request, repeatable=False)

    def archive(
        self,
        path: str | Path,
        version: str = MAIN,
        *,
        since: str | Sequence[str] | None = None,
        allow_expired_consent: str | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> Commit:
        """Write a version, all versions before it, and everything that they contain to one file.

        Return the commit of the version. The file exists only when it is complete and checked; the next call continues
        an interrupted one. The versions `since` and all before them are left out; the archive can then be imported only
        into datasets that have the versions `since`. Raises `NothingToArchive` if no version is left.

        If the consent for a clip has ended, raises `Conflict`, unless `allow_expired_consent` gives the reason why the
        clip is exported nevertheless. The server records the reason; the caller must be a maintainer or owner.
        """
        from marey_client.archives.writing import check_consents, write_archive

        bases = () if since is None else (since,) if isinstance(since, str) else since
        check = partial(check_consents, self, allow_expired_consent)
        return write_archive(self, version, Path(path), on_progress, since=bases, check=check)

    def export_files(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        path: str = "",
        format: str = DEFAULT_FORMAT,  # noqa: A002
        unit: str | None = None,
        allow_expired_consent: str | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> ExportedVersion:
        """Write the clips of a version, all or those below `path`, to motion files in a new folder.

        The files have the paths of their entries. The sidecar `marey.json` names the version and the origin of each
        clip, so that an upload of the folder restores paths and take records. The folder exists only when it is
        complete. Raises `FolderNotEmpty` if it exists already, `CannotExport` if the version has no clips or a path is
        no name of a file, and `Conflict` if the consent for a clip has ended, as `archive` does.
        """
        from marey_client.bridges.files import prepare_files, write_files

        motions = prepare_files(self, version, Path(folder), path, format, unit, allow_expired_consent)
        return write_files(motions, Path(folder), on_progress)

    def export_huggingface(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        path: str = "",
        format: str = DEFAULT_FORMAT,  # noqa: A002
        unit: str | None = None,
        allow_expired_consent: str | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder that can be uploaded to the Hugging Face Hub as a dataset.

        Its card names the commit, the licences and the lineage. Raises the errors of `export_files`.
        """
        from marey_client.bridges.files import prepare_files
        from marey_client.bridges.huggingface import write_huggingface

        motions = prepare_files(self, version, Path(folder), path, format, unit, allow_expired_consent)
        return write_huggingface(motions, Path(folder), on_progress)

    def export_lerobot(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        path: str = "",
        allow_expired_consent: str | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder as a LeRobotDataset v3.0, with one episode for each clip.

        Raises the errors of `export_files`, also `CannotExport` if the clips do not have the same skeleton and frame
        rate, and `MissingPackage` if pyarrow is not installed.
        """
        from marey_client.bridges.lerobot import prepare_lerobot, write_lerobot

        found = prepare_lerobot(self, version, Path(folder), path, allow_expired_consent)
        return write_lerobot(found, Path(folder), on_progress)

    def receive(
        self, archive: Archive, *, into: str = MAIN, on_progress: OnProgress = ignore_progress
    ) -> ImportedVersion:
        """Record the versions of an archive without checking it, and move the branch `into` to the newest of them.

        The branch stays where it is if its newest commit is not an ancestor of that version.
        """
        from marey_client.archives.receiving import send_versions

        ref = self.find_ref(into)
        empty = ref is not None and ref.commit is None
        made = send_versions(self, archive, on_progress, begins=into if empty else None)
        return self.forward(into, made)

    def forward(self, branch: str, commit: Commit) -> ImportedVersion:
        """Move a branch to a commit if the branch's newest commit is one of its ancestors.

        A branch that does not exist is created. The result contains whether the branch is at the commit now.
        """
        ref = self.find_ref(branch)
        if ref is None:
            self.create_branch(branch, commit.digest)
        elif ref.commit is None:
            self.move_branch(branch, commit.digest, expected_rev=ref.rev)
        else:
            return ImportedVersion(commit, branch, self._fast_forward(branch, commit.digest))
        return ImportedVersion(commit, branch, True)

    def _fast_forward(self, branch: str, commit: str) -> bool:
        """Move a branch to a commit if the commit follows the branch's newest one.

        Return whether the branch is at the commit now.
        """
        if self.at(branch).digest == commit:
            return True
        try:
            preview = self.merge(commit, into=branch, preview=True)
        except RequestFailed:  # nothing to merge, or no single common version: a person must decide
            return False
        if preview.base != preview.ours:
            return False
        merged = self.merge(commit, into=branch, expected=preview.ours)
        return merged.commit is not None and merged.commit.digest == commit

    # -- branches and tags ---------------------------------------------------------------------------------------------

    def refs(self) -> Iterator[Ref]:
        """List the branches and tags by name."""
        return pages(self.transport, Ref, f"{self.url}/refs")

    def find_ref(self, name: str) -> Ref | None:
        """Return the branch or tag with a name, or None."""
        return next((one for one in self.refs() if one.name == name), None)

    def create_branch(self, name: str, at: str = MAIN) -> Ref:
        """Create a branch at a version."""
        return self._create(RefCreate(name=name, kind=RefKind.BRANCH, at=at))

    def create_tag(self, name: str, at: str = MAIN) -> Ref:
        """Create a tag at a version. A tag never moves."""
        return self._create(RefCreate(name=name, kind=RefKind.TAG, at=at))

    def _create(self, request: RefCreate) -> Ref:
        return self.transport.post(Ref, f"{self.url}/refs", request)

    def move_branch(self, name: str, to: str, *, expected_rev: int | None = None) -> Ref:
        """Move a branch to any version. No commit is deleted.

        Raises `PreconditionFailed` if `expected_rev` is given and the branch has changed since.
        """
        body = as_json(RefMove(at=to))
        state = ANY_STATE if expected_rev is None else {"If-Match": f'"{expected_rev}.json"'}
        return read_model(Ref, self.transport.send("PATCH", f"{self.url}/refs/{name}", content=body, headers=state))

    def ref(self, name: str) -> Ref:
        """Return a branch with its protection, or a tag."""
        return self.transport.get(Ref, f"{self.url}/refs/{name}")

    def protect(self, branch: str, rule: ProtectionRule) -> Ref:
        """Protect a branch by a rule, which replaces an earlier rule. The caller must be a maintainer or owner."""
        body, url = as_json(rule), f"{self.url}/refs/{branch}/protection"
        return read_model(Ref, self.transport.send("PUT", url, content=body, headers=ANY_STATE))

    def unprotect(self, branch: str) -> Ref:
        """Remove the protection of a branch."""
        url = f"{self.url}/refs/{branch}/protection"
        return read_model(Ref, self.transport.send("DELETE", url, headers=ANY_STATE))

    def delete_ref(self, name: str) -> None:
        """Delete a branch or a tag; the commits stay."""
        self.transport.send("DELETE", f"{self.url}/refs/{name}", headers=ANY_STATE)
