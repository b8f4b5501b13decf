"""Task that sends events to webhooks. Of all processes that share the database, only the leader runs it.

The leader wakes up when there are events, and starts a task for each webhook that may have something to send. A task
sends the deliveries of its webhook one after another, so a slow receiver delays only its own webhook.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakValueDictionary

from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.process.services import Services
from marey_server.store import leader
from marey_server.store.database.lanes import SERVER
from marey_server.store.leader import Lead
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import NUMBERED_EVENTS, wakeups
from marey_server.store.webhooks import outbox
from marey_server.store.webhooks.outbox import Batch, Delivery, DeliveryResult, Outcome
from marey_server.webhooks.sending import MOST_AT_ONCE, MOST_OF_ONE_USER, Sender

P = ParamSpec("P")
T = TypeVar("T")

LEAD = "webhooks"
LEAD_TTL_S = 15.0
RENEW_EVERY_S = 5.0
PAUSE_S = 0.02
"""Least time between two searches for work; under load, one search serves many events."""
STOP_S = 3.0
"""Time in which running attempts may end when the server stops; attempts that take longer are repeated later."""

log = logging.getLogger(__name__)


@asynccontextmanager
async def delivering(services: Services) -> AsyncIterator[None]:
    """Send events to webhooks while the `async with` block runs, if this process is the leader."""
    deliverer = Deliverer(services)
    task = asyncio.create_task(deliverer.run())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await deliverer.close()


class Deliverer:
    """Tasks of this process that send deliveries, one for each webhook that may have something to send."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._sender = Sender(services.settings.webhook_networks)
        self._places = asyncio.Semaphore(MOST_AT_ONCE)
        self._shares: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()
        """Semaphores that limit the requests to webhooks of one user, by user, while any request uses them."""
        self._holder = secrets.token_hex(8)
        self._lead: Lead | None = None
        self._renew_at_s = 0.0
        self._lead_until_s = 0.0
        self._after: int | None = None
        self._scanned: dict[str, int] = {}
        """Number of the event up to which the feed was searched and nothing is left to send, by webhook."""
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._again: set[str] = set()
        """Webhooks that may have new events to send, which came while their task was running."""
        self._interrupted: set[str] = set()
        """Webhooks whose task ended before it had sent everything; the next search for work starts them again."""

    async def run(self) -> None:
        """Look for work whenever there are new events or a retry is due. A failure is logged, and the loop goes on."""
        with wakeups.listen([NUMBERED_EVENTS]) as listener:
            while True:
                wait_s = RENEW_EVERY_S
                try:
                    wait_s = await self._look_round()
                except ApiProblem as error:
                    log.warning("deliveries to webhooks were interrupted: %s", error.detail)
                except Exception:
                    log.exception("deliveries to webhooks failed")
                await asyncio.sleep(PAUSE_S)
                await listener.wait(wait_s)

    async def close(self) -> None:
        """Stop sending: wait a short time for attempts that are under way, then give up the lead."""
        lead, self._lead = self._lead, None
        if self._tasks:
            await asyncio.wait(self._tasks.values(), timeout=STOP_S)
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        self._sender.close()
        if lead is not None:
            try:
                await self._write(leader.give_up_lead, LEAD, self._holder)
            except ApiProblem as error:
                log.warning("deliveries can pass to another process only in %d s: %s", LEAD_TTL_S, error.detail)

    async def _look_round(self) -> float:
        """Start a task for each webhook that may have something to send.

        Return the number of seconds until the next search for such webhooks.
        """
        if not self._leads() and time.monotonic() < self._renew_at_s:
            return RENEW_EVERY_S
        work = await self._read(outbox.find_work, self._after)
        if not work.any:
            return RENEW_EVERY_S
        led = self._lead
        await self._renew_lead()
        if self._lead is None or not self._leads():
            return RENEW_EVERY_S
        if self._lead != led:
            work = await self._read(outbox.find_work, None)
        self._after = work.newest
        interrupted, self._interrupted = self._interrupted, set()
        for webhook_id in work.webhook_ids | interrupted:
            self._start(webhook_id)
        if work.next_us is None:
            return RENEW_EVERY_S
        return min(RENEW_EVERY_S, max(0.0, (work.next_us - work.now_us) / 1_000_000))

    async def _renew_lead(self) -> None:
        if time.monotonic() < self._renew_at_s:
            return
        asked_s = time.monotonic()
        fence = await self._write(leader.take_lead, LEAD, self._holder, int(LEAD_TTL_S * 1_000_000))
        self._renew_at_s = asked_s + RENEW_EVERY_S
        if fence is None:
            self._lead, self._after = None, None
            return
        if self._lead is None or self._lead.fence != fence:
            self._lead, self._after = Lead(LEAD, self._holder, fence), None
            self._scanned.clear()
        self._lead_until_s = asked_s + LEAD_TTL_S / 2

    def _leads(self) -> bool:
        """Return whether this process is the leader and remains it for some time, so that no other process can lead."""
        return self._lead is not None and time.monotonic() < self._lead_until_s

    def _start(self, webhook_id: str) -> None:
        if webhook_id in self._tasks:
            self._again.add(webhook_id)
            return
        task = asyncio.create_task(self._serve(webhook_id))
        self._tasks[webhook_id] = task
        task.add_done_callback(lambda _: self._finish(webhook_id))

    def _finish(self, webhook_id: str) -> None:
        del self._tasks[webhook_id]
        if webhook_id in self._again:
            self._again.discard(webhook_id)
            if self._leads():
                self._start(webhook_id)
            else:
                self._interrupted.add(webhook_id)

    async def _serve(self, webhook_id: str) -> None:
        """Send everything that a webhook has to send, until an attempt fails.

        If this process loses the lead, or if an error of the server interrupts the task, the next search starts a new
        task for the webhook.
        """
        interrupted = True
        try:
            going_on = True
            while going_on and self._leads():
                going_on = await self._send_batch(webhook_id)
            interrupted = going_on
        except ApiProblem as error:
            log.warning("deliveries to the webhook %s were interrupted: %s", webhook_id, error.detail)
        except Exception:
            log.exception("deliveries to the webhook %s failed", webhook_id)
        finally:
            if interrupted:
                self._interrupted.add(webhook_id)

    async def _send_batch(self, webhook_id: str) -> bool:
        """Send the next deliveries of a webhook; return whether there may be more of them."""
        newest = self._after or 0
        batch = await self._read(outbox.next_batch, webhook_id, self._scanned.get(webhook_id, 0))
        if batch is None:
            self._scanned.pop(webhook_id, None)
            return False
        before = (batch.position, batch.attempts)
        for delivery in batch.deliveries:
            outcome = await self._send(batch, delivery, before)
            if outcome is None:
                self._interrupted.add(webhook_id)
                return False
            if not delivery.requested:
                if outcome != "delivered":
                    return False
                assert delivery.number is not None
                before = (delivery.number, 0)
        if batch.complete and not batch.waits:
            await self._note_scanned(webhook_id, before[0], newest)
        return not batch.complete

    async def _note_scanned(self, webhook_id: str, position: int, newest: int) -> None:
        """Remember that no event after the number `position`, up to the number `newest`, concerns a webhook.

        The database stores this only after more than `SKIPPED_MOST` such events.
        """
        self._scanned[webhook_id] = newest
        if newest - position > outbox.SKIPPED_MOST:
            await self._write(outbox.move_on, webhook_id, position, newest)

    async def _send(self, batch: Batch, delivery: Delivery, before: tuple[int, int]) -> Outcome | None:
        """Send a delivery, record the result, and return the outcome.

        Return None if this process is no longer the leader, or if the webhook has changed since the delivery was read.
        """
        share = self._shares.get(batch.sharer) or asyncio.Semaphore(MOST_OF_ONE_USER)
        self._shares[batch.sharer] = share
        async with share, self._places:
            destination = await self._read(outbox.read_destination, delivery, before)
            lead = self._lead
            if destination is None or lead is None or not self._leads():
                return None
            result = await self._sender.send(destination, delivery)
        faults.point("webhook.before_record")
        days = self._services.settings.webhook_failing_days
        recorded = await self._write(outbox.record, lead, delivery, result, before, days)
        faults.point("webhook.after_record")
        if recorded is None:
            return None
        self._count(delivery, result, *recorded)
        return recorded.outcome

    def _count(self, delivery: Delivery, result: DeliveryResult, outcome: Outcome, now_us: int) -> None:
        metrics = self._services.metrics
        metrics.webhook_deliveries.labels(outcome).inc()
        if outcome == "delivered":
            if not delivery.requested:
                metrics.webhook_delay.observe((now_us - delivery.at_us) / 1_000_000)
            log.debug("delivered %s", delivery.id)
        else:
            level = logging.WARNING if outcome == "dead" else logging.INFO
            log.log(level, "the delivery %s failed (%s): %s", delivery.id, outcome, result.error)

    async def _read(self, function: Callable[..., T], *args: Any) -> T:
        def run(tx: Transaction) -> T:
            return function(tx, *args)

        return await asyncio.wrap_future(self._services.database.queue_read(SERVER, SYSTEM, run))

    async def _write(self, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        return await asyncio.wrap_future(self._services.database.submit_write(SYSTEM, function, *args, **kwargs))
