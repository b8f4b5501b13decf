"""Purges of deleted datasets: their versions, branches, tags and proposals are deleted for good.

A dataset is not purged while it has holders: unfinished jobs that read one of its commits, and items that jobs made
from one of its commits. So the lineage of a result always leads to the version from which it was made. If another
dataset of the project has the same commit, holders of this commit do not prevent the purge.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, delete, exists, func, select

from marey_schemas.purges import DatasetPurgeAnswer, DatasetPurgeRequest, ItemHolder, JobHolder, words_of
from marey_server import faults
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import projects
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.datasets.manifests import roots_of_folders
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import PURGED_MEANWHILE, begin_purge
from marey_server.store.purging.citations import holders_of, jobs_citing
from marey_server.store.purging.recording import STILL_HELD
from marey_server.store.tables import (
    commit_parent,
    dataset,
    dataset_commit,
    dataset_ref,
    fast_forward,
    proposal,
    proposal_check,
    proposal_comment,
    proposal_review,
    tree_chunk,
)
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.tree.chunks import Branch, decode_trusted

_OF_DATASETS = (
    proposal_check, proposal_review, proposal_comment, proposal, dataset_ref, fast_forward, commit_parent,
    dataset_commit,
)  # fmt: skip
"""Tables with rows of datasets, in an order in which they can be deleted."""


@dataclass(frozen=True)
class PreparedDatasetPurge:
    """Deleted dataset, and the results of the search that was made before its purge."""

    id: str
    commits: frozenset[str]
    """Commits that no other dataset of the project has."""
    citing: frozenset[str]
    """Ids of the jobs that read one of `commits`. As the dataset is deleted, only retries of these jobs can follow."""
    chunks: Mapping[str, int]
    """Digests of the chunks that no other dataset of the server needs, with the times when they were last stored (µs).

    Besides the chunks of this dataset, they include chunks of earlier partial checkouts that no dataset uses any more.
    """
    freed_bytes: int


def preview_dataset_purge(tx: Transaction, project: str, request: DatasetPurgeRequest) -> DatasetPurgeAnswer:
    """Return what the purge of a deleted dataset would delete, and the holders that prevent it; change nothing.

    Raises the errors of `prepare_dataset_purge`.
    """
    prepared = prepare_dataset_purge(tx, project, request)
    return _answer(tx, projects.require(tx, project), request, prepared)


def prepare_dataset_purge(tx: Transaction, project: str, request: DatasetPurgeRequest) -> PreparedDatasetPurge:
    """Find a deleted dataset, the jobs that read its versions, and the chunks that only its versions have.

    The search reads all jobs of the project and all trees of the server once. Raises `NotFoundProblem` if there is no
    such dataset, `ConflictProblem` if it is not deleted, and `ForbiddenProblem` if the caller lacks the scope `read`.
    """
    project_row = projects.require(tx, project)
    projects.require_scope(tx, project, "read")  # because the answer shows names
    row = _find(tx, project_row, request.dataset)
    others = select(dataset_commit.c.tree).where(dataset_commit.c.dataset_id != row.id)
    roots = set(tx.execute(others).scalars()) | roots_of_folders(tx, dataset.c.id != row.id)
    needed = _below(StoredChunks(tx), roots)
    chunks: dict[str, int] = {}
    size_bytes = 0
    stored = select(tree_chunk.c.digest, tree_chunk.c.created_us, func.length(tree_chunk.c.data).label("size"))
    for found in tx.execute(stored.execution_options(yield_per=1000)):
        if found.digest not in needed:
            chunks[found.digest] = found.created_us
            size_bytes += found.size
    commits = _own_commits(tx, project_row, row.id)
    return PreparedDatasetPurge(row.id, commits, jobs_citing(tx, project_row.id, commits), chunks, size_bytes)


def record_dataset_purge(
    tx: Transaction, project: str, request: DatasetPurgeRequest, prepared: PreparedDatasetPurge
) -> DatasetPurgeAnswer:
    """Delete a deleted dataset for good.

    Raises `ConflictProblem` if the dataset has holders, is not deleted, or has other commits than when the purge was
    prepared. Raises `NotFoundProblem` if there is no such dataset.
    """
    assert not request.preview, "a preview is a read"
    project_row = projects.require(tx, project)
    begin_purge(tx, project_row.id)
    if _own_commits(tx, project_row, prepared.id) != prepared.commits:
        raise ConflictProblem(
            "Versions were added or purged while this purge was prepared; send the request again.",
            code=PURGED_MEANWHILE,
        )
    answer = _answer(tx, project_row, request, prepared)
    if answer.holders:
        raise _still_held(answer)
    for table in _OF_DATASETS:
        tx.execute(delete(table).where(table.c.dataset_id == prepared.id))
    tx.execute(delete(dataset).where(dataset.c.id == prepared.id))
    _delete_chunks(tx, prepared.chunks)
    tx.audit("dataset.purged", prepared.id, about=answer.name, project_id=project_row.id, name=answer.name)
    faults.point("dataset_purge.before_commit")
    return answer


def _find(tx: Transaction, project_row: ProjectRow, name: str) -> Row[Any]:
    """Return the row of the deleted dataset with this id, or of the one with this name that was deleted last."""
    named = select(dataset).where(
        dataset.c.project_id == project_row.id, (dataset.c.id == name) | (dataset.c.name == name)
    )
    deleted = named.where(dataset.c.deleted_us.is_not(None)).order_by(dataset.c.deleted_us.desc(), dataset.c.id.desc())
    row = tx.execute(deleted.limit(1)).first()
    if row is None and tx.execute(named.limit(1)).first() is not None:
        raise ConflictProblem(f"The dataset {name!r} is not deleted; delete it first.", code="not-deleted")
    if row is None:
        raise NotFoundProblem(f"There is no deleted dataset {name!r} in this project.", code="no-dataset")
    return row


def _answer(
    tx: Transaction, project_row: ProjectRow, request: DatasetPurgeRequest, prepared: PreparedDatasetPurge
) -> DatasetPurgeAnswer:
    row = _find(tx, project_row, prepared.id)
    others = (dataset.c.project_id == project_row.id, dataset.c.name == row.name, dataset.c.id != row.id)
    held = holders_of(tx, prepared.citing)
    holders = tuple(one for one in held.holders if isinstance(one, ItemHolder | JobHolder))
    assert len(holders) == len(held.holders)  # no version of another dataset cites this one
    return DatasetPurgeAnswer(
        preview=request.preview, dataset=row.id, name=row.name, commits=_count(tx, dataset_commit, row.id),
        proposals=_count(tx, proposal, row.id), holders=holders, others=held.others,
        freed_bytes=prepared.freed_bytes,
        same_name=tx.execute(select(func.count()).where(*others, dataset.c.deleted_us.is_not(None))).scalar_one(),
    )  # fmt: skip


def _count(tx: Transaction, table: Any, dataset_id: str) -> int:
    return int(tx.execute(select(func.count()).where(table.c.dataset_id == dataset_id)).scalar_one())


# -- what cites it ----------------------------------------------------------------------------------------------------


def _own_commits(tx: Transaction, project_row: ProjectRow, dataset_id: str) -> frozenset[str]:
    """Return the commits of a dataset that no other dataset of the project has."""
    elsewhere = dataset_commit.alias("elsewhere")
    other = exists().where(
        elsewhere.c.digest == dataset_commit.c.digest,
        elsewhere.c.dataset_id != dataset_id,
        elsewhere.c.dataset_id == dataset.c.id,
        dataset.c.project_id == project_row.id,
    )
    own = select(dataset_commit.c.digest).where(dataset_commit.c.dataset_id == dataset_id, ~other)
    return frozenset(tx.execute(own).scalars())


def _still_held(answer: DatasetPurgeAnswer) -> ConflictProblem:
    more = f" and {answer.others:,} more" if answer.others else ""
    return ConflictProblem(
        f"The dataset {answer.name!r} cannot be purged, because one of its versions is cited by "
        f"{', '.join(map(words_of, answer.holders))}{more}.",
        code=STILL_HELD,
        context=answer.model_dump(mode="json"),
    )


# -- chunks -----------------------------------------------------------------------------------------------------------


def _below(store: StoredChunks, roots: Collection[str]) -> set[str]:
    """Return the digests of the chunks `roots` and of all chunks below them."""
    found: set[str] = set()
    waiting = set(roots)
    while waiting:
        batch = next(in_lists(waiting))
        waiting.difference_update(batch)
        found.update(batch)
        for digest, data in store.load(batch).items():
            chunk = decode_trusted(digest, data)
            if isinstance(chunk, Branch):
                waiting |= {child.digest for child in chunk.children}.difference(found)
    return found


def _delete_chunks(tx: Transaction, chunks: Mapping[str, int]) -> None:
    """Delete chunks, apart from those that another write has stored again since the purge was prepared.

    `chunks` maps digests to the times at which the chunks were last stored. A write that makes a tree stores its new
    chunks even if they exist already, which changes this time. All other chunks of the new tree also belong to an older
    tree of another dataset, so they are not in `chunks`.
    """
    digests = sorted(chunks)
    for some in in_lists(digests):
        locked = select(tree_chunk.c.digest, tree_chunk.c.created_us).where(tree_chunk.c.digest.in_(some))
        rows = tx.execute(locked.order_by(tree_chunk.c.digest).with_for_update()).all()
        gone = [row.digest for row in rows if row.created_us == chunks[row.digest]]
        tx.execute(delete(tree_chunk).where(tree_chunk.c.digest.in_(gone)))
