"""Commits of the outputs of jobs, made in the transactions that end the jobs.

The row of the branch is locked before the tree of the branch is read. So several jobs commit to one branch one after
another, and no commit is lost. If the branch has moved since the job started, the outputs are merged with the changes
of others. If others have changed the same part of an entry, the outputs are committed to a new branch, which is named
after the job.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

from sqlalchemy import Row, func, select, update

from marey_schemas.datasets.commits import TIME_OF_COMMIT
from marey_schemas.datasets.naming import RefKind
from marey_schemas.queue.commits import MOST_COMMITTED_AT_ONCE, MOST_LISTED, CommitConflict
from marey_schemas.wording import counted
from marey_server import faults
from marey_server.errors import NotFoundProblem
from marey_server.store.database.clock import datetime_of
from marey_server.store.datasets.chunks import store_chunks
from marey_server.store.datasets.committing import PreparedCommit, insert_commit, move_branch_to
from marey_server.store.datasets.naming import MOST_REFS, find_ref, is_tag, new_ref
from marey_server.store.datasets.output_plans import FOLDER, OutputEntries, PlannedCommit, follow, plan_outputs
from marey_server.store.datasets.protection import Mover, require_move
from marey_server.store.datasets.revisions import store_combined
from marey_server.store.projects import find_by_id
from marey_server.store.tables import dataset, dataset_commit, dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, path_and_kind


@dataclass(frozen=True)
class CommittedOutputs:
    """Result of committing the outputs of a job."""

    digest: str | None = None
    """Commit with the outputs; None if no commit was made, for example because no entry changed."""
    conflict: CommitConflict | None = None
    """Reason why the outputs are not on the intended branch."""


def lock_branch(tx: Transaction, dataset_id: str, branch: str, mover: Mover) -> Row[tuple[object, ...]]:
    """Lock a branch until the transaction ends, and return its row.

    Raises `NotFoundProblem` if the dataset or the branch was deleted, `InvalidProblem` for a tag, and the errors of
    `require_move`.
    """
    alive = select(dataset.c.id).where(dataset.c.id == dataset_id, dataset.c.deleted_us.is_(None))
    if tx.execute(alive).first() is None:
        raise NotFoundProblem("The dataset was deleted.", code="no-dataset")
    ref = find_ref(tx, dataset_id, branch, lock=True)
    if ref is None:
        raise NotFoundProblem(f"The dataset has no branch {branch!r}.", code="no-version")
    if ref.kind != RefKind.BRANCH:
        raise is_tag(branch)
    require_move(ref, mover)
    return ref


def commit_outputs(tx: Transaction, wanted: OutputEntries, mover: Mover) -> CommittedOutputs:
    """Commit the outputs of a job to its branch on behalf of `mover`. Raises the errors of `lock_branch`."""
    ref = lock_branch(tx, wanted.dataset_id, wanted.branch, mover)
    return _record_plan(tx, wanted, mover, plan_outputs(tx, wanted, ref.digest, MOST_COMMITTED_AT_ONCE))


def commit_planned(
    tx: Transaction, wanted: OutputEntries, mover: Mover, planned: PlannedCommit | None
) -> CommittedOutputs | None:
    """Commit the outputs of a job as planned by an earlier transaction, which has stored the chunks.

    Returns None if others have moved the branch so that the plan must be computed again, or if there is no plan. Raises
    the errors of `lock_branch`.
    """
    ref = lock_branch(tx, wanted.dataset_id, wanted.branch, mover)
    followed = None if planned is None else follow(tx, wanted, planned, ref.digest)
    return None if followed is None else _record_plan(tx, wanted, mover, followed)


# -- writing ----------------------------------------------------------------------------------------------------------


def _record_plan(tx: Transaction, wanted: OutputEntries, mover: Mover, planned: PlannedCommit) -> CommittedOutputs:
    """Record the commit that was planned for the present head of the branch, and move the branch to it."""
    if planned.refused is not None:
        return CommittedOutputs(conflict=planned.refused)
    if planned.merged.conflicts:
        return _on_own_branch(tx, wanted, mover, planned)
    if planned.tree == planned.head_tree:
        return CommittedOutputs()
    parents = () if planned.head is None else (planned.head,)
    _store_combined(tx, wanted, planned)
    digest = _record(tx, wanted, mover, planned, parents)
    move = PreparedCommit(wanted.dataset_id, wanted.branch, planned.head, parents, wanted.message, None)
    move_branch_to(tx, move, digest, mover)
    if planned.in_folder:
        followed = (dataset.c.id == wanted.dataset_id, dataset.c.folder_commit.is_not_distinct_from(planned.head))
        tx.execute(update(dataset).where(*followed).values(folder_commit=digest))
    tx.emit(
        "branch.moved", wanted.dataset_id, project_id=wanted.project_id, branch=wanted.branch, commit=digest,
        job=wanted.job_id,
    )  # fmt: skip
    faults.point("job_commit.after_move")
    return CommittedOutputs(digest)


def _store_combined(tx: Transaction, wanted: OutputEntries, planned: PlannedCommit) -> None:
    """Store the revisions of the entries that combine changes of the job with changes of others."""
    if planned.merged.combined:
        folder = tx.execute(FOLDER.where(dataset.c.id == wanted.dataset_id)).scalar()
        store_combined(
            tx, find_by_id(tx, wanted.project_id), folder, planned.merged.combined, planned.documents, wanted.message,
            author_id=wanted.author_id, job_id=wanted.job_id,
        )  # fmt: skip


def _record(
    tx: Transaction, wanted: OutputEntries, mover: Mover, planned: PlannedCommit, parents: Sequence[str]
) -> str:
    """Store a commit and its chunks; return the commit's digest.

    The commit may be stored already: identical jobs that end in one transaction, each with a new branch of its own,
    make the same commit.
    """
    at = datetime_of(tx.now_us).strftime(TIME_OF_COMMIT)
    record = CommitRecord(planned.tree, tuple(parents), mover.name, wanted.message, at)
    of_dataset = (dataset_commit.c.dataset_id == wanted.dataset_id, dataset_commit.c.digest == record.digest)
    if tx.execute(select(dataset_commit.c.digest).where(*of_dataset)).first() is None:
        store_chunks(tx, planned.chunks)
        faults.point("job_commit.after_chunks")
        insert_commit(tx, wanted.dataset_id, record, entries=planned.count, job_id=wanted.job_id)
        faults.point("job_commit.after_commit")
    return record.digest


def _on_own_branch(tx: Transaction, wanted: OutputEntries, mover: Mover, planned: PlannedCommit) -> CommittedOutputs:
    """Commit the outputs of a job to a new branch, because they conflict with changes of the intended branch.

    The new branch begins at the commit from which the job started. `planned` is the commit that was planned for the
    intended branch; its conflicts are the paths that changed on the intended branch while the job ran. Returns the new
    commit, with a description of the conflict. If the dataset already has `MOST_REFS` branches and tags, no commit is
    made, and only the description is returned.
    """
    paths = sorted({path_and_kind(one.key)[0] for one in planned.merged.conflicts})
    changed = f"{counted(len(paths), 'path')} of the outputs changed on {wanted.branch!r} while the job ran"
    conflict = CommitConflict(
        code="paths-changed",
        detail=f"{changed}; the first is {paths[0]!r}. The outputs are on a new branch, which can be merged.",
        paths=tuple(paths[:MOST_LISTED]),
        count=len(paths),
    )
    of_dataset = dataset_ref.c.dataset_id == wanted.dataset_id
    if tx.execute(select(func.count()).select_from(dataset_ref).where(of_dataset)).scalar_one() >= MOST_REFS:
        detail = (
            f"{changed}, and the outputs were not committed to a new branch, because the dataset already has "
            f"{MOST_REFS:,} branches and tags, which is the limit. Delete some of them, and submit the job again."
        )
        return CommittedOutputs(conflict=conflict.model_copy(update={"code": "too-many-refs", "detail": detail}))
    digest = _record(tx, wanted, mover, planned, () if wanted.base is None else (wanted.base,))
    name = _create_branch(tx, wanted, digest)
    tx.emit(
        "branch.created", wanted.dataset_id, project_id=wanted.project_id, name=name, commit=digest, job=wanted.job_id
    )
    return CommittedOutputs(digest, conflict.model_copy(update={"branch": name}))


def _create_branch(tx: Transaction, wanted: OutputEntries, digest: str) -> str:
    """Create a branch named after the id of the job, with a number added if this name is taken; return the name."""
    for number in count(1):
        name = wanted.job_id if number == 1 else f"{wanted.job_id}-{number}"
        row = new_ref(tx, wanted.dataset_id, name, RefKind.BRANCH, digest)
        insertion = tx.insert_or_ignore(dataset_ref, row).returning(dataset_ref.c.name)
        if tx.execute(insertion).first() is not None:
            return name
    raise AssertionError("the loop ends only with a return")
