"""Fault injection for tests: named points in the code where a test can kill or stop the process, or raise an error.

`MAREY_FAULT=name:kill` kills the process (SIGKILL) when it passes the point `name`; `name:stop` stops it (SIGSTOP);
`name:error` raises ENOSPC; `name@3:kill` acts on the third pass only. Several faults are separated by commas.
"""

from __future__ import annotations

import errno
import itertools
import os
import signal
import time
from collections.abc import Iterator

from marey_schemas.queue.worker_protocol import FAULT_VARIABLE


class _Fault:
    def __init__(self, text: str) -> None:
        place, _, self.action = text.partition(":")
        self.name, _, nth = place.partition("@")
        self._nth = int(nth) if nth else None
        self._passes: Iterator[int] = itertools.count(1)
        if self.action not in ("kill", "stop", "error"):
            raise ValueError(f"the variable {FAULT_VARIABLE} is {text}: its action must be kill, stop or error")

    def act(self) -> None:
        count = next(self._passes)
        if self._nth is not None and count != self._nth:
            return
        if self.action == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif self.action == "stop":
            os.kill(os.getpid(), signal.SIGSTOP)
            time.sleep(0.2)  # a stop reaches the threads of a process one by one
        else:
            raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (fault point {self.name})")


_faults: list[_Fault] = []


def plan(texts: str) -> None:
    """Replace the planned faults by those in `texts`, a text of the form that the variable `MAREY_FAULT` has."""
    _faults[:] = [_Fault(text) for text in texts.split(",") if text]


plan(os.environ.get(FAULT_VARIABLE, ""))


def point(name: str) -> None:
    """Trigger the fault that is planned for this point, if any."""
    for fault in _faults:
        if fault.name == name:
            fault.act()
