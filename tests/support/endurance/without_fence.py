"""The command `marey` of a server that does not compare fences: the negative control of the trial by faults.

A worker that has lost its job can complete it, while a later attempt runs. The server then ends the later attempt,
whose outputs are not staged yet.
"""

from __future__ import annotations

import runpy
from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import ColumnElement, and_, bindparam, select, true

from marey_schemas.queue.worker_protocol import CompleteRequest
from marey_server.store.credentials import tokens
from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs import completion, fencing
from marey_server.store.jobs.fencing import AUTHOR_MAY_RUN, RUNNING
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction

_Place = tuple[str, int]
HIGHEST = 50
_complete, _held_parameters = completion._complete, fencing.held_parameters


def _no_fence(fence: int) -> ColumnElement[bool]:
    return true()


def _any_fence(attempts: Collection[_Place]) -> dict[str, Any]:
    return _held_parameters([(job_id, fence) for job_id, _ in attempts for fence in range(HIGHEST)])


def _complete_whichever(tx: Transaction, requests: Mapping[_Place, CompleteRequest]) -> dict[_Place, Any]:
    """Complete jobs for any attempt, as the statement without the fence would."""
    rows = tx.execute(select(job.c.id, job.c.fence).where(job.c.id.in_([job_id for job_id, _ in requests])))
    newest: dict[str, int] = {row.id: row.fence for row in rows}
    moved = {(job_id, newest.get(job_id, fence)): request for (job_id, fence), request in requests.items()}
    done = _complete(tx, moved)
    return {(job_id, fence): done[place] for job_id, fence in requests if (place := (job_id, newest[job_id])) in done}


def remove() -> None:
    """Remove the comparison of fences from this process."""
    fencing.same_fence = _no_fence
    setattr(completion, "held_parameters", _any_fence)  # noqa: B010 - a name that the module imports
    completion._complete = _complete_whichever
    holds = and_(job.c.state == RUNNING, attempt.c.ended_us.is_(None) | true())
    tokens._ATTEMPT_TOKEN = Prepared(
        select(job.c.id, job.c.project_id, attempt.c.fence, attempt.c.ended_us, attempt.c.write_id)
        .add_columns(holds.label("holds"), AUTHOR_MAY_RUN.label("author_may_run"))
        .select_from(attempt.join(job, job.c.id == attempt.c.job_id))
        .where(attempt.c.token_hash == bindparam("hash"))
    )


if __name__ == "__main__":
    remove()
    runpy.run_module("marey_client.cli", run_name="__main__", alter_sys=True)
