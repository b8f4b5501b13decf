"""Lane of writes to SQLite: writes run one after another, and waiting writes share a transaction.

A commit waits for the disk, which takes longer than most writes. So waiting writes share one commit. Each write runs
under a savepoint, so a refused write rolls back only its own part. All writes are answered after the commit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ApiProblem
from marey_server.store.database.lanes import Client, FairLine, begin, finish
from marey_server.store.database.prepared import run_text
from marey_server.store.object_storage.awaiting import BytesAwaited
from marey_server.store.transaction import Transaction

T = TypeVar("T")

MOST_TOGETHER = 16
"""Greatest number of writes in one transaction; the first of them is answered only after the last has run."""
MOST_RESERVED = 12
"""Greatest number of reserved writes in a transaction while ordinary writes wait, so that ordinary writes run, too."""


@dataclass(frozen=True, slots=True)
class _Write:
    """Queued write, and the future of its result."""

    principal: Principal
    function: Callable[[Transaction], Any]
    future: Future[Any]


class WriteLane:
    """Thread that runs the queued writes; `write(principal, function)` runs a function in a transaction and commits.

    Clients take turns, as in every lane; reserved writes, such as heartbeats, come before all others.
    """

    def __init__(self, write: Callable[[Principal, Callable[[Transaction], Any]], Any]) -> None:
        self._write = write
        self._ordinary: FairLine[_Write] = FairLine()
        self._reserved: FairLine[_Write] = FairLine()
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="marey-write")

    def __len__(self) -> int:
        return len(self._ordinary) + len(self._reserved)

    def submit(
        self, client: Client, principal: Principal, function: Callable[[Transaction], T], *, reserved: bool = False
    ) -> Future[T]:
        """Queue `function(tx)`; once the transaction is committed, the future holds what the function returned.

        Raises `UnavailableProblem` if too many writes are waiting, or the lane is closed.
        """
        one = _Write(principal, function, Future())
        with self._lock:
            (self._reserved if reserved else self._ordinary).put(client, one)
        begin(self._thread, self._write_waiting, one.future)
        return one.future

    def close(self) -> None:
        """Run all waiting writes, then stop the thread."""
        self._thread.shutdown(wait=True)

    def _write_waiting(self) -> None:
        group = [one for one in self._take() if one.future.set_running_or_notify_cancel()]
        if len(group) < 2 or not self._write_together(group):
            for one in group:
                finish(one.future, partial(self._write, one.principal, one.function))

    def _take(self) -> list[_Write]:
        """Remove and return the next writes from the queues, at most `MOST_TOGETHER`."""
        taken: list[_Write] = []
        with self._lock:
            while len(taken) < MOST_TOGETHER:
                first = self._reserved.take() if len(taken) < MOST_RESERVED else None
                one = first or self._ordinary.take() or self._reserved.take()
                if one is None:
                    break
                taken.append(one)
        return taken

    def _write_together(self, group: Sequence[_Write]) -> bool:
        """Run writes in one transaction, and set their futures after the commit.

        Returns False if an unexpected error of a write has rolled back all writes; the futures are then not set. If the
        commit fails, all futures get its error.
        """
        completions: list[Callable[[], Any]] = []

        def run_all(tx: Transaction) -> None:
            completions[:] = [_run(tx, one) for one in group]

        try:
            self._write(SYSTEM, run_all)
        except Exception as failure:  # noqa: BLE001 - for whoever waits
            if not completions:
                return False
            for one in group:  # the commit failed: to write again could write twice
                one.future.set_exception(failure)
            return True
        for one, complete in zip(group, completions, strict=True):
            finish(one.future, complete)
        return True


def _run(tx: Transaction, one: _Write) -> Callable[[], Any]:
    """Run a write under a savepoint, and roll it back if it raises an `ApiProblem`, or needs bytes to be moved.

    Returns a function to be called after the commit, which returns the result of the write or raises that error.
    """
    own = tx.beside(one.principal)
    run_text(tx.connection, "SAVEPOINT this_write")
    try:
        answer = one.function(own)
    except (ApiProblem, BytesAwaited) as refusal:
        run_text(tx.connection, "ROLLBACK TO this_write")
        run_text(tx.connection, "RELEASE this_write")
        return _raiser(refusal)
    run_text(tx.connection, "RELEASE this_write")

    def complete() -> Any:
        own.run_after_commit()
        return answer

    return complete


def _raiser(refusal: ApiProblem | BytesAwaited) -> Callable[[], Any]:
    def complete() -> Any:
        raise refusal

    return complete
