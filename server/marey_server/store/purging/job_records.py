"""Removal of purged items from the records of jobs: their names, and their content that the jobs keep."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import delete, or_, select, update

from marey_server.store.jobs.result_cache import forget_results
from marey_server.store.jobs.staging import drop_staged_facets, named_blobs
from marey_server.store.tables import attempt, document_blob, job, job_blob, revision_part
from marey_server.store.transaction import Transaction, in_lists


def forget_in_jobs(tx: Transaction, items: frozenset[str], jobs: Sequence[str]) -> None:
    """Remove what the records of `jobs` contain of `items`: names, files, staged facets and cached results.

    Call this before the documents of the items are deleted.
    """
    makers: list[str] = []
    touched: set[str] = set()
    readers: set[str] = set()
    columns = (job.c.id, job.c.parent_id, job.c.inputs, job.c.outputs)
    for job_id in sorted(jobs):  # one by one, because the inputs of a job may take megabytes
        row = tx.execute(select(*columns).where(job.c.id == job_id).with_for_update()).one_or_none()
        if row is None:
            continue
        inputs, outputs = _without_names(row.inputs, items), _outputs_without_names(row.outputs, items)
        if outputs != row.outputs:
            makers.append(row.id)
        if inputs != row.inputs:
            readers.update({row.id, row.parent_id} - {None})
        if (inputs, outputs) != (row.inputs, row.outputs):
            tx.execute(update(job).where(job.c.id == row.id).values(inputs=inputs, outputs=outputs))
            touched.update({row.id, row.parent_id} - {None})
    _forget_in_answers(tx, items, makers)
    _release_files(tx, sorted(touched))
    drop_staged_facets(tx, sorted(readers))  # which no other job can share any more, without the items as inputs
    _release_sources(tx, items, makers)
    forget_results(tx, makers)


def _release_files(tx: Transaction, jobs: Sequence[str]) -> None:
    """Let garbage collection delete the files that jobs have made, such as an archive of exported clips."""
    for some in in_lists(jobs):
        results = select(job.c.id, job.c.params, job.c.result).where(job.c.id.in_(some))
        for row in tx.execute(results).all():
            if made := set(named_blobs(row.result)) - set(named_blobs(row.params)):
                of_job = job_blob.c.job_id == row.id, job_blob.c.blob_digest.in_(sorted(made))
                tx.execute(delete(job_blob).where(*of_job))


def _release_sources(tx: Transaction, items: Collection[str], makers: Sequence[str]) -> None:
    """Let garbage collection delete the files that jobs, or their parent jobs, have imported as `items`."""
    sources = (
        select(document_blob.c.blob_digest)
        .join(revision_part, revision_part.c.document_digest == document_blob.c.document_digest)
        .where(revision_part.c.item_id.in_(items))
    )
    for some in in_lists(makers):
        parents = select(job.c.parent_id).where(job.c.id.in_(some), job.c.parent_id.is_not(None))
        of_jobs = or_(job_blob.c.job_id.in_(some), job_blob.c.job_id.in_(parents))
        tx.execute(delete(job_blob).where(of_jobs, job_blob.c.blob_digest.in_(sources)))


def _forget_in_answers(tx: Transaction, items: Collection[str], jobs: Sequence[str]) -> None:
    """Remove the names of items from answers to workers, which are stored in case a worker repeats a request."""
    for some in in_lists(jobs):
        answers = select(attempt.c.job_id, attempt.c.fence, attempt.c.answer).where(
            attempt.c.job_id.in_(some), attempt.c.answer.is_not(None)
        )
        for row in tx.execute(answers).all():
            answer = {**row.answer, "outputs": _outputs_without_names(row.answer.get("outputs"), items)}
            if answer["outputs"] is not None:
                this = attempt.c.job_id == row.job_id, attempt.c.fence == row.fence
                tx.execute(update(attempt).where(*this).values(answer=answer))


def _without_names(inputs: Mapping[str, Any], items: Collection[str]) -> dict[str, Any]:
    """Return the inputs of a job, in which each of `items` has the member `purged` instead of its name and folder.

    An input whose items were distributed over tasks has no list of items, and is unchanged.
    """
    return {
        name: [_purged_pin(pin) if pin.get("item") in items else pin for pin in pins]
        if isinstance(pins, list)
        else pins
        for name, pins in inputs.items()
    }


def _purged_pin(pin: Mapping[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in pin.items() if key != "below"}
    return {**kept, "name": "", "collection": "", "purged": True}


def _outputs_without_names(
    outputs: Iterable[Mapping[str, Any]] | None, items: Collection[str]
) -> list[Mapping[str, Any]] | None:
    if outputs is None:
        return None
    return [
        {**{key: value for key, value in one.items() if key != "entry"}, "name": "", "purged": True}
        if one["item"] in items
        else one
        for one in outputs
    ]
