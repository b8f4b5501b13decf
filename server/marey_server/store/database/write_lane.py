"""Lane of writes to SQLite: they run one after another, and waiting writes share a transaction.

A commit waits for the disk, which takes longer than most writes. So waiting writes share one commit: each runs under a
savepoint, a refused write rolls back only its own part, and each is answered after the commit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Concatenate, ParamSpec, TypeVar

from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ApiProblem
from marey_server.store.database.prepared import run_text
from marey_server.store.transaction import Transaction

P = ParamSpec("P")
T = TypeVar("T")

MOST_TOGETHER = 16
"""Greatest number of writes in one transaction; the first of them is answered only after the last has run."""


@dataclass(frozen=True, slots=True)
class _Write:
    """A queued write and the future of its result."""

    principal: Principal
    function: Callable[[Transaction], Any]
    future: Future[Any]

    def end(self, finish: Callable[[], Any]) -> None:
        """Set the future to the result or the error of `finish`."""
        try:
            answer = finish()
        except BaseException as error:  # noqa: BLE001 - for whoever waits
            self.future.set_exception(error)
        else:
            self.future.set_result(answer)


class WriteLane:
    """Thread that runs writes. `write(principal, function)` runs a function in a transaction and commits."""

    def __init__(self, write: Callable[[Principal, Callable[[Transaction], Any]], Any]) -> None:
        self._write = write
        self._waiting: deque[_Write] = deque()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="marey-write")

    def submit(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Future[T]:
        """Queue `function(tx, ...)`; the future holds its return value once the transaction is committed."""
        one = _Write(principal, lambda tx: function(tx, *args, **kwargs), Future())
        self._waiting.append(one)
        self._thread.submit(self._write_waiting)
        return one.future

    def close(self) -> None:
        """Run all waiting writes, then stop the thread."""
        self._thread.shutdown(wait=True)

    def _write_waiting(self) -> None:
        taken = [self._waiting.popleft() for _ in range(min(len(self._waiting), MOST_TOGETHER))]
        group = [one for one in taken if one.future.set_running_or_notify_cancel()]
        if len(group) < 2 or not self._write_together(group):
            for one in group:
                one.end(lambda one=one: self._write(one.principal, one.function))  # type: ignore[misc]

    def _write_together(self, group: Sequence[_Write]) -> bool:
        """Run writes in one transaction; return whether it was committed. An unexpected error rolls back all."""
        finishes: list[Callable[[], Any]] = []

        def run_all(tx: Transaction) -> None:
            finishes[:] = [_run(tx, one) for one in group]

        try:
            self._write(SYSTEM, run_all)
        except Exception as failure:  # noqa: BLE001 - for whoever waits
            if not finishes:
                return False
            for one in group:  # the commit failed: to write again could write twice
                one.future.set_exception(failure)
            return True
        for one, finish in zip(group, finishes, strict=True):
            one.end(finish)
        return True


def _run(tx: Transaction, one: _Write) -> Callable[[], Any]:
    """Run a write and return its completion, to be called after the commit; a refused write is rolled back."""
    own = tx.beside(one.principal)
    run_text(tx.connection, "SAVEPOINT this_write")
    try:
        answer = one.function(own)
    except ApiProblem as refusal:
        run_text(tx.connection, "ROLLBACK TO this_write")
        run_text(tx.connection, "RELEASE this_write")
        return _raiser(refusal)
    run_text(tx.connection, "RELEASE this_write")

    def finish() -> Any:
        own.run_after_commit()
        return answer

    return finish


def _raiser(refusal: ApiProblem) -> Callable[[], Any]:
    def finish() -> Any:
        raise refusal

    return finish
