"""Handle of a dataset: its versions, branches and tags."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, Unpack

from marey_client.access import ANY_STATE
from marey_client.arguments import checked, checks_arguments
from marey_client.errors import NotFound
from marey_client.handles.bisections import Bisection, IsBad, OnStep, bisect, read_range
from marey_client.handles.proposals import Proposals
from marey_client.paging import pages
from marey_client.progress import OnProgress, ignore_progress
from marey_client.transport import Params, Transport, as_json, named_path, read_model
from marey_schemas.datasets.checkouts import CheckoutAnswer, CheckoutRequest
from marey_schemas.datasets.commits import Commit, CommitCreate, Entry, EntryChange, EntryOrigins
from marey_schemas.datasets.differences import DatasetDifference, ListedCommit
from marey_schemas.datasets.merges import MergeAnswer, MergeRequest, PickRequest, Resolution
from marey_schemas.datasets.naming import MAIN, Dataset, Ref, RefCreate, RefKind, RefMove
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from marey_client.bridges.files import ExportedVersion, FileExportOptions
    from marey_client.bridges.version import ExportOptions


class PickOptions(TypedDict, total=False):
    """Keyword arguments of `DatasetHandle.cherry_pick` and `DatasetHandle.revert`."""

    into: str
    """Branch that gets the changes; default: main."""
    parent: Literal[1, 2]
    """For a merge commit: number of the parent (1 or 2) from which the changes of the commit are counted."""
    message: str
    """Message of the commit; default: a sentence that names the commit."""
    resolutions: tuple[Resolution, ...]
    """Decisions for conflicts, which the commit applies."""
    preview: bool
    """Whether the result is only computed, so that no commit is made. Default: False."""
    expected: str
    """Commit that must be the newest commit of the branch."""


@checks_arguments
@dataclass(frozen=True)
class DatasetHandle:
    """Handle of a dataset; requests are sent only by its methods.

    A version is the name of a branch or a tag, or the digest of a commit, of which the first 8 digits are enough. Each
    of these with `~n` at its end is the version n commits earlier.
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
        """Read the dataset: its folder, its description, and the version that is checked out."""
        return self.transport.get(Dataset, self.url)

    def delete(self) -> None:
        """Delete the dataset; the items of the project stay, and the name can be used again.

        The versions are stored until the deleted dataset is purged. Raises `Conflict` if a branch is protected.
        """
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
        """Record a new version: the content of the dataset's folder, or the newest version with `changes` applied.

        If the answer is lost, the request is sent again and returns the commit that was made the first time. Raises
        `Conflict` if `expected` is given and is not the newest commit of the branch.
        """
        request = checked(
            CommitCreate,
            branch=branch,
            message=message,
            changes=None if changes is None else tuple(changes),
            expected=expected,
            write_id=secrets.token_hex(16),
        )
        return self.transport.post(Commit, f"{self.url}/commits", request)

    def log(self, version: str = MAIN, *, path: str = "") -> Iterator[ListedCommit]:
        """List a version and the versions before it, newest first; of a merge, only the first parent is followed.

        With `path`, list only the commits that changed the entry or the folder at this path, each with the number of
        entries that it added, removed, moved and changed there.
        """
        return pages(self.transport, ListedCommit, f"{self.url}/commits", {"version": version, "path": path})

    def at(self, version: str = MAIN) -> Commit:
        """Return the commit that a version names: a branch, a tag or a digest."""
        return self.transport.get(Commit, named_path(f"{self.url}/commits", version))

    def has(self, commit: str) -> bool:
        """Return whether the dataset has the commit with this digest."""
        try:
            return self.at(commit).digest == commit
        except NotFound:
            return False

    def entries(self, version: str = MAIN, *, path: str = "") -> Iterator[Entry]:
        """List the entries of a version, sorted by path; with `path`, only the entries below this folder."""
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
        request = checked(
            MergeRequest,
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
        request = checked(PickRequest, version=version, write_id=secrets.token_hex(16), **options)
        return self.transport.post(MergeAnswer, f"{self.url}/{resource}", request)

    def blame(self, path: str, kind: Kind, version: str = MAIN) -> EntryOrigins:
        """Return, for each part of an entry, for its path and for its tags, the commit that changed it last."""
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
        """Find the first bad version after `good` on the way to `bad`, by bisection.

        `is_bad` is called with the commit of each version to test, first with `good` and `bad`. It returns whether the
        version is bad, or None if the version cannot be tested. With `first_parent`, only the first parent of each
        merge is followed. `ProjectHandle.bisect` tests a metric of the evaluation of each version.

        Raises `CannotBisect` if `good` is not among the versions before `bad`, if `is_bad` does not return False for
        `good`, or if it does not return True for `bad`.
        """
        return bisect(read_range(self, good, bad, first_parent=first_parent), is_bad, on_step)

    def check_out(
        self, version: str = MAIN, *, query: str | None = None, paths: Sequence[str] = (), discard: bool = False
    ) -> CheckoutAnswer:
        """Change the folder of the dataset to the content of a version.

        With `query`, only entries that the query selects are checked out; with `paths`, only entries at one of the
        paths or below it. The server stores this selection: later commits of the folder keep all other entries.

        Raises `Conflict` if the folder has changes that no commit has recorded, unless `discard` is true.
        """
        request = checked(CheckoutRequest, version=version, query=query, paths=tuple(paths), discard=discard)
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

        Return the commit of the version. The file exists only when it is complete and checked. After an interruption,
        the next call continues to write. The versions `since` and all versions before them are left out; then the
        archive can be imported only into datasets that have the versions `since`. Raises `NothingToArchive` if no
        version is left.

        If the consent for a clip has ended, raises `Conflict`, unless `allow_expired_consent` gives a reason to export
        the clip nevertheless. The server records the reason; the caller must be a maintainer or owner.
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
        on_progress: OnProgress = ignore_progress,
        **options: Unpack[FileExportOptions],
    ) -> ExportedVersion:
        """Write all clips of a version, or the clips below the option `path`, to motion files in a new folder.

        The files have the paths of their entries. The sidecar `marey.json` names the version and the origin of each
        clip, so that an upload of the folder restores paths and take records. The folder exists only when it is
        complete. Raises `FolderNotEmpty` if the folder exists and is not empty. Raises `CannotExport` if the version
        has no clips, or if the path of a clip cannot be a file name. Raises `Conflict` if the consent for a clip has
        ended, as `archive` does.
        """
        from marey_client.bridges.files import prepare_files, write_files

        motions = prepare_files(self, version, Path(folder), **options)
        return write_files(motions, Path(folder), on_progress)

    def export_huggingface(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        on_progress: OnProgress = ignore_progress,
        **options: Unpack[FileExportOptions],
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder that can be uploaded to the Hugging Face Hub as a dataset.

        The dataset card, `README.md`, names the commit, the licences and the lineage. Raises the errors of
        `export_files`.
        """
        from marey_client.bridges.files import prepare_files
        from marey_client.bridges.huggingface import write_huggingface

        motions = prepare_files(self, version, Path(folder), **options)
        return write_huggingface(motions, Path(folder), on_progress)

    def export_lerobot(
        self,
        folder: str | Path,
        version: str = MAIN,
        *,
        on_progress: OnProgress = ignore_progress,
        **options: Unpack[ExportOptions],
    ) -> ExportedVersion:
        """Write the clips of a version to a new folder as a LeRobotDataset v3.0, with one episode for each clip.

        Raises the errors of `export_files`. Also raises `CannotExport` if the clips differ in skeleton, joints with
        positions or frame rate, and `MissingPackage` if pyarrow is not installed.
        """
        from marey_client.bridges.lerobot import prepare_lerobot, write_lerobot

        found = prepare_lerobot(self, version, Path(folder), **options)
        return write_lerobot(found, Path(folder), on_progress)

    # -- branches and tags ---------------------------------------------------------------------------------------------

    def refs(self) -> Iterator[Ref]:
        """List the branches and tags by name."""
        return pages(self.transport, Ref, f"{self.url}/refs")

    def find_ref(self, name: str) -> Ref | None:
        """Return the branch or the tag with this name; None if there is none, or if the dataset does not exist."""
        try:
            return self.ref(name)
        except NotFound:
            return None

    def create_branch(self, name: str, at: str = MAIN) -> Ref:
        """Create a branch that begins at the version `at`. Raises `Conflict` if the name is taken."""
        return self._create(checked(RefCreate, name=name, kind=RefKind.BRANCH, at=at))

    def create_tag(self, name: str, at: str = MAIN) -> Ref:
        """Create a tag at a version. A tag never moves."""
        return self._create(checked(RefCreate, name=name, kind=RefKind.TAG, at=at))

    def _create(self, request: RefCreate) -> Ref:
        return self.transport.post(Ref, f"{self.url}/refs", request)

    def move_branch(self, name: str, to: str, *, expected_rev: int | None = None) -> Ref:
        """Move a branch to any version. No commit is deleted.

        Raises `PreconditionFailed` if `expected_rev` is given and is not the present `rev` of the branch.
        """
        body = as_json(RefMove(at=to))
        state = ANY_STATE if expected_rev is None else {"If-Match": f'"{expected_rev}.json"'}
        return read_model(Ref, self.transport.send("PATCH", self._ref(name), content=body, headers=state))

    def ref(self, name: str) -> Ref:
        """Return the branch or the tag with this name; a branch includes its protection rule.

        Raises `NotFound` if there is none.
        """
        return self.transport.get(Ref, self._ref(name))

    def protect(self, branch: str, rule: ProtectionRule) -> Ref:
        """Protect a branch by a rule, which replaces an earlier rule. The caller must be a maintainer or owner."""
        body, url = as_json(rule), f"{self._ref(branch)}/protection"
        return read_model(Ref, self.transport.send("PUT", url, content=body, headers=ANY_STATE))

    def unprotect(self, branch: str) -> Ref:
        """Remove the protection of a branch."""
        url = f"{self._ref(branch)}/protection"
        return read_model(Ref, self.transport.send("DELETE", url, headers=ANY_STATE))

    def _ref(self, name: str) -> str:
        return named_path(f"{self.url}/refs", name)

    def delete_ref(self, name: str) -> None:
        """Delete a branch or a tag; the commits stay."""
        self.transport.send("DELETE", self._ref(name), headers=ANY_STATE)
