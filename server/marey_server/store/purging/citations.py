"""Citations of versions of datasets: jobs that read a version, and items that these jobs made from it.

A version that is cited keeps its commit and its tag, so that the lineage of a result leads to a version with a name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from sqlalchemy import Row, select

from marey_schemas.datasets.naming import RefKind
from marey_schemas.kinds import Kind
from marey_schemas.purges import ItemHolder, JobHolder, words_of
from marey_schemas.queue.jobs import JobState, commits_of
from marey_server.errors import ConflictProblem
from marey_server.store import projects
from marey_server.store.datasets.naming import delete_ref, find_dataset, find_ref
from marey_server.store.jobs.reading import UNFINISHED
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.purging.holders import FoundHolders
from marey_server.store.revs import ExpectedRev
from marey_server.store.tables import collection, dataset_ref, item, job, revision
from marey_server.store.transaction import Transaction, in_lists


def find_citations(tx: Transaction, project: str, name: str, ref: str) -> frozenset[str]:
    """Return the ids of the jobs that have read the version of a tag; none for a branch.

    The function takes long, because it reads all jobs of the project.
    """
    project_row = projects.require(tx, project)
    found = find_ref(tx, find_dataset(tx, project_row, name).id, ref)
    if found is None or found.kind != RefKind.TAG:
        return frozenset()
    return jobs_citing(tx, project_row.id, frozenset([found.digest]))


def delete_uncited_ref(
    tx: Transaction, project: str, name: str, ref: str, citing: frozenset[str], *, expected_rev: ExpectedRev
) -> None:
    """Delete a branch or a tag; `citing` are the jobs that `find_citations` has found.

    A job that is submitted meanwhile is not affected, because it names its version by digest. Raises the errors of
    `delete_ref`. Also raises `ConflictProblem` if the version is cited, by a job that has not ended or by an item that
    a job made, and no other tag names the version.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_ref(tx, find_dataset(tx, project_row, name).id, ref)
    delete_ref(tx, project, name, ref, expected_rev=expected_rev)  # which locks all branches and tags
    held = holders_of(tx, citing)
    if found is None or not held.holders or _has_tag(tx, found):
        return
    more = f" and {held.others:,} more" if held.others else ""
    raise ConflictProblem(
        f"The tag {ref!r} cannot be deleted, because its version is cited by "
        f"{', '.join(map(words_of, held.holders))}{more}. Purge what cites it, or create another tag of the same "
        "version first.",
        code="tag-cited",
        context={"holders": [one.model_dump(mode="json") for one in held.holders], "others": held.others},
        unnamed=f"The tag {ref!r} cannot be deleted, because its version is cited. Purge what cites it, or create "
        "another tag of the same version first.",
    )


def _has_tag(tx: Transaction, ref: Row[Any]) -> bool:
    """Return whether another tag names the version of `ref`, a branch or tag that this transaction has deleted."""
    same = (dataset_ref.c.dataset_id == ref.dataset_id, dataset_ref.c.digest == ref.digest)
    named = select(dataset_ref.c.name).where(*same, dataset_ref.c.kind == RefKind.TAG.value)
    return tx.execute(named.limit(1)).first() is not None


def jobs_citing(tx: Transaction, project_id: str, commits: frozenset[str]) -> frozenset[str]:
    """Return the ids of the jobs of the project whose inputs were taken from one of `commits`."""
    if not commits:
        return frozenset()
    jobs = select(job.c.id, job.c.inputs).where(job.c.project_id == project_id).execution_options(yield_per=10)
    return frozenset(row.id for row in tx.execute(jobs) if not commits.isdisjoint(commits_of(row.inputs)))


def _with_retries(tx: Transaction, citing: Iterable[str]) -> set[str]:
    """Return the ids of the jobs `citing`, of all their retries, and of the tasks of all these jobs."""
    found = set(citing)
    ahead = found
    while ahead:
        further: set[str] = set()
        for some in in_lists(sorted(ahead)):
            further.update(tx.execute(select(job.c.id).where(job.c.retry_of.in_(some))).scalars())
            further.update(tx.execute(select(job.c.id).where(job.c.parent_id.in_(some))).scalars())
        ahead = further - found
        found = found | further
    return found


def holders_of(tx: Transaction, citing: Collection[str]) -> FoundHolders:
    """Return the holders of the versions that the jobs `citing` have read; they prevent the deletion of the versions.

    Two kinds of objects are holders: jobs that have not ended, and items that the jobs have made, except purged items.
    The retries and the tasks of the jobs are included.
    """
    held = FoundHolders()
    ordered = sorted(_with_retries(tx, citing))
    items: set[str] = set()
    for some in in_lists(ordered):
        jobs = select(job.c.id, job.c.kind, job.c.state).where(
            job.c.id.in_(some), job.c.state.in_(UNFINISHED), job.c.parent_id.is_(None)
        )
        for row in tx.execute(jobs.order_by(job.c.id)):
            held.add(JobHolder(job=row.id, kind=row.kind, state=JobState(row.state)))
        items.update(tx.execute(select(revision.c.item_id).where(revision.c.job_id.in_(some))).scalars())
    for some in in_lists(sorted(items)):
        made = (
            select(item.c.id, item.c.kind, item.c.name, item.c.deleted_us, collection.c.path)
            .join(collection, collection.c.id == item.c.collection_id)
            .where(item.c.id.in_(some), item.c.purged_us.is_(None))
        )
        for row in tx.execute(made.order_by(item.c.id)):
            path = f"{row.path}/{row.name}".lstrip("/")
            held.add(ItemHolder(item=row.id, kind=Kind(row.kind), path=path, deleted=row.deleted_us is not None))
    return held
