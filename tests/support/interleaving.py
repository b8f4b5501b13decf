"""Two interleaved transactions: the second begins when the first has written but not committed."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from dataclasses import dataclass
from typing import Any

from tests.support.patience import PATIENCE_S

from marey_server.access.principal import Principal
from marey_server.errors import ApiProblem
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction

Action = Callable[..., Any]
"""Function that runs in a transaction, which is its argument."""

HEAD_START_S = 0.1
"""Time for which the second transaction may run, or wait for locks of the first, before the first one commits."""


@dataclass(frozen=True)
class Step:
    """One of the two transactions: its function, its database connection and its principal."""

    database: Database
    principal: Principal
    action: Action


class Abandoned(Exception):
    """Error that rolls back the first transaction on request."""


def interleave(first: Step, second: Step, *, commit: bool = True) -> tuple[Any, Any]:
    """Interleave two transactions; return the result or error of each. Without `commit`, the first is rolled back."""
    wrote, began, may_end = threading.Event(), threading.Event(), threading.Event()

    def held_open(tx: Transaction) -> Any:
        try:
            answer = first.action(tx)
        finally:
            wrote.set()
        may_end.wait(PATIENCE_S)
        if not commit:
            raise Abandoned
        return answer

    def begun(tx: Transaction) -> Any:
        began.set()
        return second.action(tx)

    with ThreadPoolExecutor(2) as pool:
        one = pool.submit(first.database.write, first.principal, held_open)
        assert wrote.wait(PATIENCE_S)
        two = pool.submit(second.database.write, second.principal, begun)
        if not second.database.is_sqlite:  # on SQLite, the second transaction begins when the first one has ended
            assert began.wait(PATIENCE_S)
        with contextlib.suppress(StillRunning):
            two.exception(HEAD_START_S)
        may_end.set()
        return _outcome(one), _outcome(two)


def _outcome(future: Future[Any]) -> Any:
    try:
        return future.result(PATIENCE_S)
    except (ApiProblem, Abandoned) as error:
        return error
