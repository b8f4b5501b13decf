"""Heartbeats that renew a lease while its job runs, sent by a separate thread on the monotonic clock."""

from __future__ import annotations

import logging
import threading
import time

from marey_client.errors import LeaseLost, MareyError
from marey_schemas.backoff import spread
from marey_schemas.queue.jobs import Progress
from marey_schemas.queue.worker_protocol import HeartbeatAnswer, Lease
from marey_worker.attempt_api import AttemptApi

log = logging.getLogger(__name__)

CONFIRM_AFTER = 2 / 3
"""Greatest age of the last successful heartbeat when a job is completed or failed, as a share of the lease's duration.

If the last success is older, another heartbeat must succeed before the end of the job is reported.
"""

PROGRESS_EVERY_S = 2.0
RETRY_S = 1.0
FIRST_S = 1.0
"""Greatest delay in seconds of the first heartbeat, which shows the server that the job runs.

Jobs that end sooner send no heartbeat.
"""

TICK_S = 0.25
JITTER = 0.2
"""Largest share of an interval that is subtracted at random, so that attempts send heartbeats at different times."""


class LeaseKeeper:
    """Thread that sends the heartbeats of one attempt.

    `lost` is set when the server reports that the lease is lost, and `cancelled` when it reports that the job was
    cancelled. If the server does not answer, heartbeats are retried and the job continues; `confirm` checks the lease
    before results are published.
    """

    def __init__(self, api: AttemptApi, lease: Lease) -> None:
        self.lost = threading.Event()
        self.cancelled = threading.Event()
        self._api = api
        self._job = lease.job
        self._interval_s = lease.heartbeat_s
        self._ttl_s = lease.lease_ttl_s
        self._answered = self._tried = time.monotonic()
        self._progress: Progress | None = None
        self._reported: Progress | None = None
        self._confirming = False
        self._stopped = threading.Event()
        self._beating = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"heartbeat-{lease.job}", daemon=True)
        self._thread.start()

    def set_progress(self, progress: Progress) -> None:
        """Set the progress that the next heartbeat reports."""
        self._progress = progress

    def stop(self) -> None:
        """Stop sending heartbeats."""
        self._stopped.set()

    def confirm(self, *, patiently: bool) -> None:
        """Make sure that the lease is valid, before the end of the job is reported.

        A heartbeat is sent unless a recent one has succeeded. With `patiently`, it is retried for up to 10 minutes.
        Raises `LeaseLost` if the lease is lost, or the client's error if the server does not answer.
        """
        self._confirming = True
        if self.lost.is_set() or time.monotonic() - self._answered > CONFIRM_AFTER * self._ttl_s:
            self._beat(patiently=patiently)

    def _run(self) -> None:
        wait_s = spread(min(FIRST_S, self._interval_s), JITTER)
        while not self._stopped.wait(TICK_S):
            silent_s = time.monotonic() - self._tried
            unreported = self._progress is not self._reported and silent_s >= PROGRESS_EVERY_S
            if unreported or silent_s >= wait_s:
                wait_s = spread(self._interval_s if self._try_beat() else RETRY_S, JITTER)

    def _try_beat(self) -> bool:
        try:
            self._beat()
        except LeaseLost as error:
            if not self._confirming:  # the final request ends the lease, and a heartbeat may follow it
                log.warning("%s: %s", self._job, error)
            self.lost.set()
            self._stopped.set()
        except MareyError as error:
            log.warning("%s: a heartbeat failed: %s", self._job, error)
            return False
        return True

    def _beat(self, *, patiently: bool = False) -> None:
        with self._beating:
            progress = self._progress
            self._tried = time.monotonic()
            answer: HeartbeatAnswer = self._api.heartbeat(progress, patiently=patiently)
            self._answered = time.monotonic()
            self._reported = progress
            self._ttl_s = answer.lease_ttl_s
            if answer.cancel_requested:
                self.cancelled.set()
