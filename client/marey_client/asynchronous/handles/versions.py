"""Counterparts of `marey_client.handles.versions` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Unpack

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.handles.bisections import AsyncIsBad, AsyncOnStep
from marey_client.asynchronous.handles.proposals import AsyncProposals
from marey_client.asynchronous.progress import AsyncOnProgress
from marey_client.bridges.files import ExportedVersion, FileExportOptions
from marey_client.bridges.version import ExportOptions
from marey_client.handles.bisections import Bisection
from marey_client.handles.versions import DatasetHandle, PickOptions
from marey_client.progress import ignore_progress
from marey_schemas.datasets.checkouts import CheckoutAnswer
from marey_schemas.datasets.commits import Commit, Entry, EntryChange, EntryOrigins
from marey_schemas.datasets.differences import DatasetDifference, ListedCommit
from marey_schemas.datasets.merges import MergeAnswer, Resolution
from marey_schemas.datasets.naming import MAIN, Dataset, Ref
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.kinds import Kind


@counterpart_of(DatasetHandle)
class AsyncDatasetHandle(Counterpart):
    """Handle of a dataset; requests are sent only by its methods.

    A version is the name of a branch or a tag, or the digest of a commit, of which the first 8 digits are enough. Each
    of these with `~n` at its end is the version n commits earlier.
    """

    _sync: DatasetHandle

    @property
    def url(self) -> str:
        return self._sync.url

    @property
    def name(self) -> str:
        """The name of the dataset."""
        return self._sync.name

    @property
    def project_url(self) -> str:
        """The path of the project, relative to the API's root."""
        return self._sync.project_url

    async def read(self) -> Dataset:
        """Read the dataset: its folder, its description, and the version that is checked out."""
        return await self._run(self._sync.read)

    async def delete(self) -> None:
        """Delete the dataset; the items of the project stay, and the name can be used again.

        The versions are stored until the deleted dataset is purged. Raises `Conflict` if a branch is protected.
        """
        await self._run(self._sync.delete)

    @property
    def proposals(self) -> AsyncProposals:
        """The proposals to merge versions into branches of the dataset."""
        exchanged: AsyncProposals = self._as_async(self._sync.proposals)
        return exchanged

    async def commit(
        self,
        message: str,
        *,
        branch: str = MAIN,
        changes: Sequence[EntryChange] | None = None,
        expected: str | None = None,
    ) -> Commit:
        """Record a new version: the content of the dataset's folder, or the newest version with `changes` applied.

        If the answer is lost, the request is sent again and returns the commit that was made the first time. Raises
        `Conflict` if `expected` is given and is not the newest commit of the branch.
        """
        return await self._run(self._sync.commit, message, branch=branch, changes=changes, expected=expected)

    def log(self, version: str = MAIN, *, path: str = "") -> AsyncIterator[ListedCommit]:
        """List a version and the versions before it, newest first; of a merge, only the first parent is followed.

        With `path`, list only the commits that changed the entry or the folder at this path, each with the number of
        entries that it added, removed, moved and changed there.
        """
        return self._each(self._sync.log, version, path=path)

    async def at(self, version: str = MAIN) -> Commit:
        """Return the commit that a version names: a branch, a tag or a digest."""
        return await self._run(self._sync.at, version)

    async def has(self, commit: str) -> bool:
        """Return whether the dataset has the commit with this digest."""
        return await self._run(self._sync.has, commit)

    def entries(self, version: str = MAIN, *, path: str = "") -> AsyncIterator[Entry]:
        """List the entries of a version, sorted by path; with `path`, only the entries below this folder."""
        return self._each(self._sync.entries, version, path=path)

    async def difference(
        self, before: str = f"{MAIN}~1", after: str = MAIN, *, path: str = "", limit: int = 1000
    ) -> DatasetDifference:
        """Return the entries that differ between two versions, at most `limit` of them.

        With `path`, only the entry or the folder at this path is compared.
        """
        return await self._run(self._sync.difference, before, after, path=path, limit=limit)

    async def merge(
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
        return await self._run(
            self._sync.merge,
            version,
            into=into,
            message=message,
            resolutions=resolutions,
            preview=preview,
            expected=expected,
        )

    async def cherry_pick(self, version: str, **options: Unpack[PickOptions]) -> MergeAnswer:
        """Repeat the changes of one commit on a branch.

        Raises `Conflict` with the code `merge-conflicts` if the branch has changed the same parts.
        """
        return await self._run(self._sync.cherry_pick, version, **options)

    async def revert(self, version: str, **options: Unpack[PickOptions]) -> MergeAnswer:
        """Undo the changes of one commit on a branch; later changes stay.

        Raises `Conflict` with the code `merge-conflicts` if later commits have changed the same parts.
        """
        return await self._run(self._sync.revert, version, **options)

    async def blame(self, path: str, kind: Kind, version: str = MAIN) -> EntryOrigins:
        """Return, for each part of an entry, for its path and for its tags, the commit that changed it last."""
        return await self._run(self._sync.blame, path, kind, version)

    async def bisect(
        self, good: str, bad: str, is_bad: AsyncIsBad, *, first_parent: bool = False, on_step: AsyncOnStep | None = None
    ) -> Bisection:
        """Find the first bad version after `good` on the way to `bad`, by bisection.

        `is_bad` is called with the commit of each version to test, first with `good` and `bad`. It returns whether the
        version is bad, or None if the version cannot be tested. With `first_parent`, only the first parent of each
        merge is followed. `ProjectHandle.bisect` tests a metric of the evaluation of each version.

        Raises `CannotBisect` if `good` is not among the versions before `bad`, if `is_bad` does not return False for
        `good`, or if it does not return True for `bad`.
        """
        exchanged: Bisection = await self._exchange(
            self._sync.bisect, good, bad, is_bad, first_parent=first_parent, on_step=on_step
        )
        return exchanged

    async def check_out(
        self, version: str = MAIN, *, query: str | None = None, paths: Sequence[str] = (), discard: bool = False
    ) -> CheckoutAnswer:
        """Change the folder of the dataset to the content of a version.

        With `query`, only entries that the query selects are checked out; with `paths`, only entries at one of the
        paths or below it. The server stores this selection: later commits of the folder keep all other entries.

        Raises `Conflict` if the folder has changes that no commit has recorded, unless `discard` is true.
        """
        return await self._run(self._sync.check_out, version, query=query, paths=paths, discard=discard)

    async def archive(
        self,
        path: str | Path,
        version: str = MAIN,
        *,
        since: str | Sequence[str] | None = None,
        allow_expired_consent: str | None = None,
        on_progress: AsyncOnProgress = ignore_progress,
    ) -> Commit:
        """Write a version, all versions before it, and everything that they contain to one file.

        Return the commit of the version. The file exists only when it is complete and checked. After an interruption,
        the next call continues to write. The versions `since` and all versions before them are left out; then the
        archive can be imported only into datasets that have the versions `since`. Raises `NothingToArchive` if no
        version is left.

        If the consent for a clip has ended, raises `Conflict`, unless `allow_expired_consent` gives a reason to export
        the clip nevertheless. The server records the reason; the caller must be a maintainer or owner.
        """
        exchanged: Commit = await self._exchange(
            self._sync.archive,
            path,
            version,
            since=since,
            allow_expired_consent=allow_expired_consent,
            on_progress=on_progress,
        )
        return exchanged

    async def export_files(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        on_progress: AsyncOnProgress = ignore_progress,
        **options: Unpack[FileExportOptions],
    ) -> ExportedVersion:
        """Write all clips of a version, or the clips below the option `path`, to motion files in a new folder.

        The files have the paths of their entries. The sidecar `marey.json` names the version and the origin of each
        clip, so that an upload of the folder restores paths and take records. The folder exists only when it is
        complete. Raises `FolderNotEmpty` if the folder exists and is not empty. Raises `CannotExport` if the version
        has no clips, or if the path of a clip cannot be a file name. Raises `Conflict` if the consent for a clip has
        ended, as `archive` does.
        """
        exchanged: ExportedVersion = await self._exchange(
            self._sync.export_files, folder, version, on_progress=on_progress, **options
        )
        return exchanged

    async def export_huggingface(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        on_progress: AsyncOnProgress = ignore_progress,
        **options: Unpack[FileExportOptions],
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder that can be uploaded to the Hugging Face Hub as a dataset.

        The dataset card, `README.md`, names the commit, the licences and the lineage. Raises the errors of
        `export_files`.
        """
        exchanged: ExportedVersion = await self._exchange(
            self._sync.export_huggingface, folder, version, on_progress=on_progress, **options
        )
        return exchanged

    async def export_lerobot(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        on_progress: AsyncOnProgress = ignore_progress,
        **options: Unpack[ExportOptions],
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder as a LeRobotDataset v3.0, with one episode for each clip.

        Raises the errors of `export_files`. Also raises `CannotExport` if the clips differ in skeleton, joints with
        positions or frame rate, and `MissingPackage` if pyarrow is not installed.
        """
        exchanged: ExportedVersion = await self._exchange(
            self._sync.export_lerobot, folder, version, on_progress=on_progress, **options
        )
        return exchanged

    def refs(self) -> AsyncIterator[Ref]:
        """List the branches and tags by name."""
        return self._each(self._sync.refs)

    async def find_ref(self, name: str) -> Ref | None:
        """Return the branch or the tag with this name; None if there is none, or if the dataset does not exist."""
        return await self._run(self._sync.find_ref, name)

    async def create_branch(self, name: str, at: str = MAIN) -> Ref:
        """Create a branch that begins at the version `at`. Raises `Conflict` if the name is taken."""
        return await self._run(self._sync.create_branch, name, at)

    async def create_tag(self, name: str, at: str = MAIN) -> Ref:
        """Create a tag at a version. A tag never moves."""
        return await self._run(self._sync.create_tag, name, at)

    async def move_branch(self, name: str, to: str, *, expected_rev: int | None = None) -> Ref:
        """Move a branch to any version. No commit is deleted.

        Raises `PreconditionFailed` if `expected_rev` is given and is not the present `rev` of the branch.
        """
        return await self._run(self._sync.move_branch, name, to, expected_rev=expected_rev)

    async def ref(self, name: str) -> Ref:
        """Return the branch or the tag with this name; a branch includes its protection rule.

        Raises `NotFound` if there is none.
        """
        return await self._run(self._sync.ref, name)

    async def protect(self, branch: str, rule: ProtectionRule) -> Ref:
        """Protect a branch by a rule, which replaces an earlier rule. The caller must be a maintainer or owner."""
        return await self._run(self._sync.protect, branch, rule)

    async def unprotect(self, branch: str) -> Ref:
        """Remove the protection of a branch."""
        return await self._run(self._sync.unprotect, branch)

    async def delete_ref(self, name: str) -> None:
        """Delete a branch or a tag; the commits stay."""
        await self._run(self._sync.delete_ref, name)
