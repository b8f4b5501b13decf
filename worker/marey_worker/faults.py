"""Fault injection for tests: named points in the code where a test can kill or stop a worker.

`MAREY_FAULT=worker.after_claim:kill` kills the process (SIGKILL) when it passes that point, `:stop` stops it (SIGSTOP);
`worker.after_blob@3:kill` acts on the third pass. Several faults are separated by commas; points of other programs are
ignored. Points: `worker.after_claim`, `worker.after_blob`, `worker.before_complete`, `worker.after_complete`.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter

from marey_schemas.queue.worker_protocol import FAULT_VARIABLE

SETTLE_S = 0.2
"""Pause of the calling thread after SIGSTOP, which stops the threads one by one and may reach this thread last."""
ACTIONS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}

_passes: Counter[str] = Counter()


def point(name: str) -> None:
    """Trigger the fault that the environment requests for this point, if any."""
    wanted = os.environ.get(FAULT_VARIABLE)
    if not wanted:
        return
    _passes[name] += 1
    for text in wanted.split(","):
        place, _, action = text.partition(":")
        where, _, nth = place.partition("@")
        if where == name and action in ACTIONS and (not nth or int(nth) == _passes[name]):
            os.kill(os.getpid(), ACTIONS[action])
            time.sleep(SETTLE_S)
