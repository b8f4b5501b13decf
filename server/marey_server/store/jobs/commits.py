"""Commits of the outputs of jobs: checks at submission, and the commit in the transaction that ends the job.

A job commits once: tasks of a fan-out publish their outputs, and the parent job commits these outputs when it ends. If
the commit is not allowed any more, the job fails and publishes nothing. The same happens if the author of the job may
not write to the folders of its outputs any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Any

from pydantic import ValidationError
from sqlalchemy import and_, select

from marey_schemas.access import Role
from marey_schemas.datasets.naming import RefKind
from marey_schemas.imports import published_result
from marey_schemas.kinds import Kind
from marey_schemas.problems import FieldError
from marey_schemas.queue.commits import MOST_COMMITTED, MOST_COMMITTED_AT_ONCE, JobCommit, OutputsCommit
from marey_schemas.queue.job_kinds import job_kinds
from marey_schemas.queue.jobs import FailureReason, JobOutput
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_server.access import roles, scopes
from marey_server.access.folder_rights import FolderRoleProblem
from marey_server.errors import (
    AUTHOR_LOST,
    ApiProblem,
    DamagedProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
)
from marey_server.store.datasets.committing import author_of
from marey_server.store.datasets.contents import find_contents_of, store_contents
from marey_server.store.datasets.folders import tags_of
from marey_server.store.datasets.naming import find_dataset, find_ref, is_tag
from marey_server.store.datasets.output_plans import OutputEntries, PlannedCommit, too_many_changes
from marey_server.store.datasets.outputs import CommittedOutputs, commit_outputs, commit_planned
from marey_server.store.datasets.protection import Mover, require_move
from marey_server.store.jobs import staging
from marey_server.store.jobs.endings import failure_document
from marey_server.store.jobs.staging import StagedDraft
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import job, member, user
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import DatasetEntry, RevisionKey, key_of
from marey_versions.tree.chunks import DamagedChunk

Target = dict[str, Any]
"""Commit that a job is to make, in the form in which the job stores it.

It has the fields of `OutputsCommit` and four others: `dataset_id`; `base`, the newest commit of the branch when the
job's input revisions were fixed; `within`, the path of the dataset's folder; and `kinds`, the kinds of the outputs.
"""


# -- submission -------------------------------------------------------------------------------------------------------


def check_target(
    tx: Transaction, project: ProjectRow, kind: KindDeclaration, request: OutputsCommit, into: str, at: str
) -> Target:
    """Check the commit of outputs that a submission requests, and return it in the form in which the job stores it.

    `into` is the collection of the job's results. Raises `InvalidProblem` with a JSON Pointer below `at` for an unknown
    dataset or branch, for a tag, for a kind of job that creates no items, and if the commit would replace the whole
    dataset. Raises `ForbiddenProblem` or `ConflictProblem` if the caller may not commit to the branch.
    """
    if not scopes.allows(tx.principal.scopes, "write", project.name):
        raise ForbiddenProblem(
            f"A job that commits its outputs needs a token with the scopes 'jobs' and 'write' in the project "
            f"{project.name!r}.",
            code="insufficient-scope",
        )
    if not roles.includes(project.role, Role.CONTRIBUTOR):  # the caller may have this role in some folders only
        raise ForbiddenProblem(
            f"A job that commits its outputs requires at least the role {Role.CONTRIBUTOR.value} in the project "
            f"{project.name!r}.",
            code="insufficient-role",
        )
    kinds = kinds_made_by(kind)
    if not kinds:
        raise _invalid(at, "no-outputs", f"Jobs of the kind {kind.name} create no items to commit.")
    try:
        found = find_dataset(tx, project, request.dataset)
    except NotFoundProblem as error:
        raise _invalid(f"{at}/dataset", error.error_code, error.detail) from None
    ref = find_ref(tx, found.id, request.branch)
    if ref is None:
        detail = f"The dataset {request.dataset!r} has no branch {request.branch!r}."
        raise _invalid(f"{at}/branch", "no-version", detail)
    if ref.kind != RefKind.BRANCH:
        raise _invalid(f"{at}/branch", "is-tag", is_tag(request.branch).detail)
    try:
        require_move(ref, Mover(author_of(tx), project.role))
    except ApiProblem as error:
        fault = FieldError(pointer=f"{at}/branch", code=error.error_code, detail=error.detail)
        raise type(error)(error.detail, code=error.error_code, errors=[fault], unnamed=error.unnamed) from None
    target = {
        **request.model_dump(), "dataset_id": found.id, "base": ref.digest, "within": found.path or "", "kinds": kinds,
    }  # fmt: skip
    if request.replace and not _entry_folder(target, into):
        detail = "The commit would replace the whole dataset; name a folder of the dataset."
        raise _invalid(f"{at}/replace", "whole-dataset", detail)
    return target


def kinds_made_by(kind: KindDeclaration) -> list[str]:
    """Return the kinds of the items that jobs of a kind create."""
    return sorted({one.value for one in kind.outputs.values() if isinstance(one, Kind)})


def check_again(
    tx: Transaction, project: ProjectRow, kind: KindDeclaration, target: Target | None, into: str
) -> Target | None:
    """Check the commit of a job that is retried; return it, or None if the job makes no commit.

    The commit keeps its base, an earlier commit of the branch. If the dataset was deleted and another one has its name
    now, the base is the newest commit of the branch in the new dataset. Raises the errors of `check_target`.
    """
    if target is None:
        return None
    request = OutputsCommit.model_validate({name: target[name] for name in OutputsCommit.model_fields})
    checked = check_target(tx, project, kind, request, into, "/commit")
    return {**checked, "base": target["base"]} if checked["dataset_id"] == target["dataset_id"] else checked


def with_new_base(tx: Transaction, target: Target | None) -> Target | None:
    """Return the commit that a job is to make, with the present newest commit of the branch as its base.

    Called when the outputs of other jobs become inputs of the job. `target` is returned unchanged if it is None, or if
    the branch does not exist.
    """
    ref = None if target is None else find_ref(tx, target["dataset_id"], target["branch"])
    return target if target is None or ref is None else {**target, "base": ref.digest}


def shown_commit(row: Any) -> JobCommit | None:
    """Return the commit of a job as a document, or None if the job makes no commit.

    A task makes no commit, because its parent job commits the outputs of all tasks.
    """
    target: Target | None = row.commit_to
    if target is None or row.parent_id is not None:
        return None
    return JobCommit.model_validate(
        {**target, "folder": _entry_folder(target, row.into_path), "message": _message(row), "digest": row.committed}
    )


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, errors=[FieldError(pointer=pointer, code=code, detail=detail)])


def _entry_folder(target: Target, into: str, below: str = "") -> str:
    """Return the folder to which outputs of a job are committed, as a path in the dataset.

    `into` is the collection of the job's results, and `below` is the folder of the outputs relative to `into`.
    """
    if target["folder"] is not None:
        return _joined(target["folder"], below)
    place, within = _joined(into, below), target["within"]
    return f"{place}/".removeprefix(f"{within}/").rstrip("/") if within else place


def _joined(*names: str) -> str:
    return "/".join(filter(None, names))


# -- the end of a job -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PublishedOutputs:
    """Published outputs of a job, and the values of the columns of the job that record its commit.

    If `failure` is set, nothing was published. Either the author of the job may not write to a folder of the outputs
    any more, or the commit is not allowed.
    """

    outputs: list[dict[str, Any]] = field(default_factory=list)
    columns: Mapping[str, Any] = field(default_factory=dict)
    failure: dict[str, Any] | None = None

    @property
    def commit(self) -> str | None:
        """The digest of the commit that has the outputs; None if there is no commit."""
        return self.columns.get("committed")

    def result(self, kind: str, result: dict[str, Any]) -> dict[str, Any]:
        """Return the result of the job, with what was published added to its entries for files.

        Only results of kinds with `reports_entries` have such entries. Raises `InvalidProblem` if an entry is not
        valid.
        """
        declaration = job_kinds().get(kind)
        if declaration is None or not declaration.reports_entries or "entries" not in result:
            return result
        try:
            return published_result(result, {one["name"]: JobOutput.model_validate(one) for one in self.outputs})
        except ValidationError as error:
            detail = "The result of the job is not valid: each of its `entries` must be a valid `ImportEntry`."
            raise InvalidProblem(detail) from error


JOB_COLUMNS = (
    job.c.id,
    job.c.project_id,
    job.c.kind,
    job.c.parent_id,
    job.c.into_path,
    job.c.author_id,
    job.c.message,
    job.c.commit_to,
)
"""Columns of a job that are read to publish and commit its outputs."""


def publish_outputs(tx: Transaction, row: Any, drafts: Mapping[str, StagedDraft]) -> PublishedOutputs:
    """Publish the drafts of a job, and commit them if the request for the job asks for a commit.

    A task only publishes its drafts, which its parent job commits later. Nothing is published if the commit is refused,
    or if the author of the job may not write to a folder of the outputs. The result then contains the failure. `row`
    has the columns `JOB_COLUMNS`.
    """
    if row.commit_to is None and not drafts:
        return PublishedOutputs()
    if row.commit_to is not None and row.parent_id is None:
        hold_off_purges(tx, row.project_id)
    try:
        with tx.connection.begin_nested():
            if row.commit_to is None:
                return PublishedOutputs(staging.publish_drafts(tx, row, drafts))
            outputs = _publish_entries(tx, row, drafts)
            return PublishedOutputs(outputs, {} if row.parent_id is not None else _commit(tx, row, outputs))
    except _CommitRefused as error:
        return PublishedOutputs(failure=error.failure)
    except FolderRoleProblem as error:
        folder = error.context["folder"]
        detail = f"The author of the job may not write to the folder {folder!r} of the results."
        return PublishedOutputs(failure=failure_document(FailureReason.ERROR, AUTHOR_LOST, detail))


def commit_tasks(tx: Transaction, row: Any) -> PublishedOutputs:
    """Commit the outputs of all tasks of a parent job, if the request for the job asks for a commit.

    The result contains the commit, or the failure if it was refused. `row` has the columns `JOB_COLUMNS`.
    """
    if row.commit_to is None:
        return PublishedOutputs()
    hold_off_purges(tx, row.project_id)
    try:
        return PublishedOutputs([], _commit(tx, row, list(_outputs_of_tasks(tx, row.id))))
    except _CommitRefused as error:
        return PublishedOutputs(failure=error.failure)


def entries_of_tasks(tx: Transaction, row: Any) -> OutputEntries:
    """Return the outputs of all tasks of a parent job as dataset entries. `row` has the columns `JOB_COLUMNS`.

    At most `MOST_COMMITTED` + 1 outputs are read, because a commit of more than `MOST_COMMITTED` is refused anyway.
    """
    return _entries_of(tx, row, islice(_outputs_of_tasks(tx, row.id), MOST_COMMITTED + 1))


def commit_planned_tasks(
    tx: Transaction, row: Any, wanted: OutputEntries, planned: PlannedCommit | None
) -> PublishedOutputs | None:
    """Commit the outputs `wanted` of a parent job, as `planned` by an earlier transaction.

    Returns None if the commit must be planned again (see `commit_planned`). If the commit is refused, the result
    contains the failure. `row` has the columns `JOB_COLUMNS`.
    """
    try:
        with tx.connection.begin_nested():
            made = commit_planned(tx, wanted, _mover(tx, row), planned)
    except ApiProblem as error:
        return PublishedOutputs(failure=refused_commit(row.commit_to, error.error_code, error.detail))
    return None if made is None else PublishedOutputs([], _columns(made))


def _outputs_of_tasks(tx: Transaction, parent_id: str) -> Iterable[Mapping[str, Any]]:
    """Return the outputs of all tasks of a parent job, in the order of the tasks."""
    tasks = select(job.c.outputs).where(job.c.parent_id == parent_id).order_by(job.c.position)
    for of_task in tx.execute(tasks.execution_options(yield_per=10)).scalars():
        yield from of_task or ()


class _CommitRefused(Exception):
    """Error for outputs of a job that may not be committed to the branch of the job."""

    def __init__(self, target: Target, error: ApiProblem) -> None:
        super().__init__(error.detail)
        self.failure = refused_commit(target, error.error_code, error.detail)


def refused_commit(target: Target, code: str, reason: str) -> dict[str, Any]:
    """Return the failure of a job whose outputs cannot be committed; `reason` is one or several sentences."""
    detail = f"The outputs cannot be committed to {target['dataset']}@{target['branch']}. {reason}"
    return failure_document(FailureReason.ERROR, code, detail)


def _publish_entries(tx: Transaction, row: Any, drafts: Mapping[str, StagedDraft]) -> list[dict[str, Any]]:
    """Publish the drafts of a job, and return its outputs with the paths of their entries.

    Also stores the content digests of the outputs, so that a parent job need not compute them.
    """
    outputs = staging.publish_drafts(tx, row, drafts)
    store_contents(tx, find_contents_of(tx, row.project_id, map(_revision, outputs)))
    return [{**one, "entry": _entry_path(row, drafts[one["name"]])} for one in outputs]


def _entry_path(row: Any, draft: StagedDraft) -> str:
    return _joined(_entry_folder(row.commit_to, row.into_path, draft["collection"]), draft["item_name"])


def _revision(output: Mapping[str, Any]) -> RevisionKey:
    return RevisionKey(output["item"], output["revision"])


def _commit(tx: Transaction, row: Any, outputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Commit outputs on behalf of the job's author; return the columns of the job that record the commit."""
    if not outputs:
        return {}
    if len(outputs) > MOST_COMMITTED_AT_ONCE:
        return _columns(CommittedOutputs(conflict=too_many_changes(MOST_COMMITTED_AT_ONCE)))
    try:
        return _columns(commit_outputs(tx, _entries_of(tx, row, outputs), _mover(tx, row)))
    except ApiProblem as error:
        raise _CommitRefused(row.commit_to, error) from None
    except DamagedChunk as error:
        problem = DamagedProblem(
            f"The stored data of the dataset are damaged: {error}. Ask the operator to run `marey db fsck`."
        )
        raise _CommitRefused(row.commit_to, problem) from error


def _columns(made: CommittedOutputs) -> dict[str, Any]:
    conflict = None if made.conflict is None else made.conflict.model_dump(mode="json")
    return {"committed": made.digest, **({} if conflict is None else {"publish_conflict": conflict})}


def _entries_of(tx: Transaction, row: Any, outputs: Iterable[Mapping[str, Any]]) -> OutputEntries:
    target: Target = row.commit_to
    entries: dict[str, DatasetEntry] = {}
    revisions: dict[str, RevisionKey] = {}
    for some in in_lists(outputs):
        contents = find_contents_of(tx, row.project_id, map(_revision, some))
        tags = tags_of(tx, sorted({one["item"] for one in some}))
        for one in some:
            path = _free_path(one, revisions)
            entry = DatasetEntry(path, one["kind"], contents.parts[_revision(one)], tags.get(one["item"], ()))
            entries[entry.key], revisions[entry.key] = entry, _revision(one)
    return OutputEntries(
        dataset_id=target["dataset_id"], project_id=row.project_id, branch=target["branch"], base=target["base"],
        entries=entries, revisions=revisions, message=_message(row), job_id=row.id, author_id=row.author_id,
        replaced=_entry_folder(target, row.into_path) if target["replace"] else None, kinds=target["kinds"],
    )  # fmt: skip


def _free_path(output: Mapping[str, Any], taken: Mapping[str, RevisionKey]) -> str:
    """Return the path of an output, with a number added if another item of the same job has this path.

    Two outputs may have the same name if items with equal content are reused.
    """
    for number in count(1):
        path = output["entry"] if number == 1 else f"{output['entry']}-{number}"
        other = taken.get(key_of(path, output["kind"]))
        if other is None or other.item == output["item"]:
            return str(path)
    raise AssertionError("the loop ends only with a return")


def _message(row: Any) -> str:
    return row.commit_to["message"] or f"Results of {row.kind} {row.id}"


def _mover(tx: Transaction, row: Any) -> Mover:
    """Return the author of a job with the role that the author has now; the server itself counts as an owner.

    Raises `ForbiddenProblem` if the author is disabled, or may not write to the project any more.
    """
    if row.author_id is None:
        return Mover(str(tx.principal.actor), Role.OWNER)
    in_project = and_(member.c.user_id == user.c.id, member.c.project_id == row.project_id)
    found = tx.execute(
        select(user.c.name, user.c.administrator, user.c.disabled, member.c.role)
        .select_from(user.outerjoin(member, in_project))
        .where(user.c.id == row.author_id)
    ).one()
    role = Role.OWNER if found.administrator else found.role and Role(found.role)
    if found.disabled or role is None or not roles.includes(role, Role.CONTRIBUTOR):
        raise ForbiddenProblem("The author of the job may not write to the project any more.", code=AUTHOR_LOST)
    return Mover(found.name, role)
