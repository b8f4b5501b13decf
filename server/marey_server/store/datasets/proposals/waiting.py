"""Automatic merges of proposals (`when_green`): each proposal is merged as soon as it meets all requirements.

When a review or a report of a check arrives, the server tries the merge at once. The last requirement can also be met
by other changes: a changed rule, a moved target, a new role of the user who requested the merge. So the server examines
all waiting proposals regularly.
"""

from __future__ import annotations

import logging
import math
import time
from typing import NamedTuple

from sqlalchemy import select, tuple_

from marey_schemas.lru import LruCache
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem, UnavailableProblem
from marey_server.store.database.connections import Database
from marey_server.store.datasets.proposals.accepting import (
    MergeBasis,
    PreparedAcceptance,
    WaitingOutcome,
    merge_basis,
    merge_if_green,
    prepare_waiting,
)
from marey_server.store.datasets.proposals.opening import find_proposal, lock_open
from marey_server.store.projects import find_by_id
from marey_server.store.purge_lock import PURGED_MEANWHILE, hold_off_purges
from marey_server.store.tables import dataset, project, proposal
from marey_server.store.transaction import Transaction

EXAMINED_AT_ONCE = 100
"""Greatest number of proposals that one call of `WaitingMerges.attempt` examines."""
FAILED_MERGES_KEPT = 10_000
"""Greatest number of proposals whose last failed merge a process remembers."""
REFUSED_PAUSE_S = 60.0
"""Seconds until a merge that was refused, for example because of a quota, is computed again on the same basis."""

log = logging.getLogger(__name__)


class _PendingMerge(NamedTuple):
    """Proposal for which an automatic merge (`when_green`) is requested."""

    dataset_id: str
    number: int
    dataset: str
    project_id: str
    project: str


class _FailedMerge(NamedTuple):
    """Failed merge of a proposal: `basis` is everything on which the result of the merge depends.

    A merge on the same basis is not tried again before `again_s`, a time in seconds of the monotonic clock.
    """

    basis: MergeBasis
    again_s: float


class WaitingMerges:
    """Executor of automatic merges, in rounds: a round takes the proposals in the order of dataset and number."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._last = ("", 0)
        self._failed_merges: LruCache[tuple[str, int], _FailedMerge] = LruCache(max_entries=FAILED_MERGES_KEPT)
        """Last failed merge of each proposal, by the id of the dataset and the number of the proposal."""

    def attempt(self) -> int:
        """Examine the next `EXAMINED_AT_ONCE` waiting proposals, and merge those that are ready.

        Returns the number of merged proposals. A proposal that another request changes meanwhile is examined again in
        the next round. After an error with one proposal, the other proposals are still examined. Only
        `UnavailableProblem` ends the call.
        """
        found = self._database.read(SYSTEM, _next_waiting, self._last)
        merged = sum(map(self._attempt_one, found))
        self._last = (found[-1].dataset_id, found[-1].number) if len(found) == EXAMINED_AT_ONCE else ("", 0)
        return merged

    def _attempt_one(self, one: _PendingMerge) -> bool:
        key = one.dataset_id, one.number
        basis: MergeBasis | None = None
        try:
            basis = self._database.read(SYSTEM, _basis_if_ready, one)
            if basis is None or self._has_failed(key, basis):
                return False
            prepared = self._database.read(SYSTEM, prepare_waiting, one.project, one.dataset, one.number)
            outcome = self._database.submit_write(SYSTEM, _merge, one, prepared).result()
        except UnavailableProblem:
            raise
        except ApiProblem as problem:
            log.info("proposal %d of %s is examined again later: %s", one.number, one.dataset_id, problem.detail)
            pause_s = 0.0 if problem.error_code == PURGED_MEANWHILE else REFUSED_PAUSE_S
        except Exception:
            log.exception("proposal %d of %s cannot be merged", one.number, one.dataset_id)
            pause_s = REFUSED_PAUSE_S
        else:
            pause_s = math.inf if outcome is WaitingOutcome.OBSTRUCTED else 0.0
            if outcome is WaitingOutcome.MERGED:
                return True
        if basis is not None and pause_s:
            self._failed_merges.put(key, _FailedMerge(basis, time.monotonic() + pause_s))
        return False

    def _has_failed(self, key: tuple[str, int], basis: MergeBasis) -> bool:
        last = self._failed_merges.get(key)
        return last is not None and last.basis == basis and time.monotonic() < last.again_s


def _next_waiting(tx: Transaction, last: tuple[str, int]) -> list[_PendingMerge]:
    columns = proposal.c.dataset_id, proposal.c.number
    statement = (
        select(*columns, dataset.c.name, dataset.c.project_id, project.c.name.label("project"))
        .join(dataset, dataset.c.id == proposal.c.dataset_id)
        .join(project, project.c.id == dataset.c.project_id)
        .where(proposal.c.when_green_id.is_not(None), tuple_(*columns) > last)
        .where(dataset.c.deleted_us.is_(None), project.c.deleted_us.is_(None))
        .order_by(*columns)
        .limit(EXAMINED_AT_ONCE)
    )
    return [_PendingMerge._make(row) for row in tx.execute(statement)]


def _basis_if_ready(tx: Transaction, one: _PendingMerge) -> MergeBasis | None:
    """Return the basis of the merge of a waiting proposal; None if approvals, checks or rights are missing."""
    row = find_proposal(tx, one.dataset_id, one.number)
    return merge_basis(tx, find_by_id(tx, one.project_id), row)


def _merge(tx: Transaction, one: _PendingMerge, prepared: PreparedAcceptance | None) -> WaitingOutcome:
    """Merge a waiting proposal if all requirements are met."""
    hold_off_purges(tx, one.project_id)
    row = lock_open(tx, one.dataset_id, one.number)
    return merge_if_green(tx, one.project, one.dataset, row, prepared)
