"""Periodic work of the server, called housekeeping.

It reclaims expired leases, and completes waiting jobs with the results of identical jobs. It propagates the ends of
jobs with many dependants. It commits the outputs of jobs that have many outputs, merges waiting proposals, and submits
the jobs of due schedules. It deletes old or unreferenced data. Only the leading process does this work, except that
each process propagates ends, and cleans its own data folder. Even concurrent housekeeping would be safe, because every
statement checks its conditions again. Each kind of work runs in a separate task, so that a failure does not affect the
other kinds.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem, UnavailableProblem
from marey_server.process.services import Services
from marey_server.store import leader, rate_limits
from marey_server.store.credentials import browser_sign_ins
from marey_server.store.datasets.proposals import WaitingMerges
from marey_server.store.garbage import collect_garbage
from marey_server.store.jobs import reaper
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.jobs.propagation import postpone_rest, propagate_rest
from marey_server.store.jobs.reaper import StartGrace
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_upkeep.moving import move_uploads
from marey_server.store.retention import retire
from marey_server.store.schedules.firing import submit_due
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import ENDS_TO_PROPAGATE, OUTPUTS_TO_COMMIT, Listener, wakeups

P = ParamSpec("P")
T = TypeVar("T")
Chore = Callable[[Services, str], Awaitable[None]]
"""Function that does one kind of work; its arguments are the services and this process's name as leader."""

log = logging.getLogger(__name__)

LEAD = "housekeeping"
LEAD_TTL_US = 30_000_000
LONGEST_TICK_S = 5.0
GARBAGE_EVERY_S = 3600.0
FORGET_TRIES_EVERY_S = 60.0
MOVE_EVERY_S = 10.0
FIRST_GARBAGE_S = 60.0
"""Seconds from the start to the first garbage collection; short, because some servers run only an hour."""


@asynccontextmanager
async def running_housekeeping(services: Services) -> AsyncIterator[None]:
    """Run the periodic work while the `async with` block runs; then end the leadership of this process."""
    holder = secrets.token_hex(8)
    tick_s = min(LONGEST_TICK_S, services.queue_policy.lease_ttl_s / 4)
    merges = WaitingMerges(services.database)
    with (  # all the time, so that no job is missed during a commit
        wakeups.listen([OUTPUTS_TO_COMMIT]) as listener,
        wakeups.listen([ENDS_TO_PROPAGATE]) as of_ends,
    ):
        chores = (
            (tick_s, tick_s, _reclaim_leases),
            (tick_s, tick_s, _share_results),
            (tick_s, tick_s, partial(_merge_waiting, merges=merges)),
            (tick_s, tick_s, _submit_scheduled),
            (0.0, 0.0, partial(_commit_outputs, listener=listener, longest_wait_s=tick_s)),
            (0.0, 0.0, partial(_propagate_ends, listener=of_ends, longest_wait_s=tick_s)),
            (FORGET_TRIES_EVERY_S, FORGET_TRIES_EVERY_S, _forget_tries),
            (FIRST_GARBAGE_S, GARBAGE_EVERY_S, _collect_garbage),
            (FIRST_GARBAGE_S, GARBAGE_EVERY_S, _remove_index_copies),
            (MOVE_EVERY_S, MOVE_EVERY_S, partial(_move_uploads, damaged=set())),
        )
        tasks = [asyncio.create_task(_repeat(services, holder, *chore)) for chore in chores]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await _give_up_lead(services, holder)


async def _give_up_lead(services: Services, holder: str) -> None:
    """Give up the leadership of this process.

    If the database is unreachable, the leadership ends when its lease expires.
    """
    try:
        await _write(services, leader.give_up_lead, LEAD, holder)
    except ApiProblem as error:
        log.warning("housekeeping can pass to another process only in %d s: %s", LEAD_TTL_US / 1_000_000, error.detail)


async def _repeat(services: Services, holder: str, first_s: float, every_s: float, chore: Chore) -> None:
    """Call `chore` after `first_s` seconds, and then again and again, `every_s` seconds after the last call has ended.

    A failure is logged and does not stop the repetition.
    """
    await asyncio.sleep(first_s)
    while True:
        try:
            await chore(services, holder)
        except ApiProblem as error:
            log.warning("housekeeping was interrupted: %s", error.detail)
        except Exception:
            log.exception("housekeeping failed")
        await asyncio.sleep(every_s)


async def _reclaim_leases(services: Services, holder: str) -> None:
    """Reclaim every expired lease, page by page, if this process is the leader.

    Nothing is reclaimed during the grace period after a start or an interruption, in which workers renew their leases.
    """
    try:
        leads, may_reclaim = await _write(services, _look_round, holder, services.start_grace)
        if leads and may_reclaim:
            await _reclaim_pages(services)
    except UnavailableProblem:
        services.start_grace.restart()
        raise


def _look_round(tx: Transaction, holder: str, grace: StartGrace) -> tuple[bool, bool]:
    """Return whether this process is the leader, and whether the grace period is over.

    In the grace period after a start or an interruption, workers can renew leases that expired in the meantime.
    """
    return _leads(tx, holder), grace.over(tx.now_us)


async def _reclaim_pages(services: Services) -> None:
    if await _write(services, reaper.correct_times, services.queue_policy):
        log.warning("the database's clock was set back; times of leases were corrected")
    page = await _write(services, reaper.reap_page, services.queue_policy)
    taken = page.taken
    while page.after is not None:
        page = await _write(services, reaper.reap_page, services.queue_policy, page.after)
        taken += page.taken
    if taken:
        log.warning("took %d jobs back from workers that no longer send heartbeats", taken)


async def _share_results(services: Services, holder: str) -> None:
    """Complete waiting jobs with the results of identical jobs that have succeeded, if this process is the leader."""
    if await _write(services, _leads, holder):
        while await _write(services, reaper.share_waiting) > 0:
            pass


async def _merge_waiting(services: Services, holder: str, merges: WaitingMerges) -> None:
    """Merge the waiting proposals that now meet all requirements, if this process is the leader."""
    if await _write(services, _leads, holder):
        await _in_thread(services, merges.attempt)


async def _submit_scheduled(services: Services, holder: str) -> None:
    """Submit the jobs of some due schedules, if this process is the leader and the disk is not full."""
    if services.disk.fault() is None and await _write(services, _leads, holder):
        await _in_thread(services, submit_due, services.database)


async def _commit_outputs(services: Services, holder: str, *, listener: Listener, longest_wait_s: float) -> None:
    """Commit the outputs of jobs that have many outputs, and end these jobs, if this process is the leader.

    First wait until there is such a job, but at most `longest_wait_s` seconds.
    """
    await listener.wait(longest_wait_s)
    if await _write(services, _leads, holder):
        await _in_thread(services, commit_deferred, services.database)


async def _propagate_ends(services: Services, _holder: str, *, listener: Listener, longest_wait_s: float) -> None:
    """Propagate, in short transactions, the ends of jobs that earlier transactions have not propagated completely.

    First wait until there are such ends, but at most `longest_wait_s` seconds, because another process may have ended.
    After an unexpected error, the ends concerned must wait until all others are propagated.
    """
    await listener.wait(longest_wait_s)
    try:
        while await _write(services, propagate_rest):
            pass
    except ApiProblem:
        raise
    except Exception:
        await _write(services, postpone_rest)
        raise


def _leads(tx: Transaction, holder: str) -> bool:
    """Become or remain the leader for housekeeping, if possible; return whether this process is the leader."""
    return leader.take_lead(tx, LEAD, holder, LEAD_TTL_US) is not None


async def _collect_garbage(services: Services, holder: str) -> None:
    if await _write(services, _leads, holder):
        retired = await _in_thread(services, retire, services.database, services.settings.retention)
        collected = await _in_thread(services, collect_garbage, services.database)
        log.info("deleted old rows: %s; deleted unused rows: %s", retired, collected)


async def _remove_index_copies(services: Services, _holder: str) -> None:
    """Remove this server's copies of index files that were deleted from the store, for example after a purge.

    Child processes that have searched these files keep them mapped into memory, so they are replaced.
    """
    removed = await _in_thread(services, services.database.read, SYSTEM, services.index_files.remove_unstored)
    if removed:
        services.children.renew()
        log.info("removed the copies of %d files of indexes that are no longer stored", removed)


async def _move_uploads(services: Services, holder: str, damaged: set[str]) -> None:
    """Move finished uploads from the database to object storage, if the setting `blobs` stores new blobs there.

    The digests of uploads that cannot be moved are added to `damaged`, so that they are not tried again.
    """
    database = services.database
    if isinstance(database.blobs, ObjectBlobs) and await _write(services, _leads, holder):
        moved = await asyncio.wrap_future(database.submit_move(partial(move_uploads, database, frozenset(damaged))))
        damaged.update(moved.damaged)
        for digest in moved.damaged:
            log.error("the upload %s is damaged and stays in the database; run `marey db fsck`", digest)


async def _in_thread(services: Services, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    return await asyncio.wrap_future(services.compute_threads.submit_housekeeping(function, *args, **kwargs))


async def _forget_tries(services: Services, holder: str) -> None:
    """Delete expired counts of tries to sign in, and browser sign-ins that were not completed in time.

    The deletion takes little time, because there are few rows: each sign-in adds three rows, and passwords are hashed
    one by one.
    """
    if await _write(services, _leads, holder):
        while await _write(services, rate_limits.forget_ended) == rate_limits.FORGOTTEN_AT_ONCE:
            pass
        while await _write(services, browser_sign_ins.delete_expired) == rate_limits.FORGOTTEN_AT_ONCE:
            pass


async def _write(
    services: Services, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs
) -> T:
    return await asyncio.wrap_future(services.database.submit_write(SYSTEM, function, *args, **kwargs))
