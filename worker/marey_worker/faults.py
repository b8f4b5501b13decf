"""Places where a test can make a worker die or stop, to see what it leaves behind.

`MAREY_FAULT=worker.after_claim:kill` kills the process (SIGKILL) when it passes that point, `:stop` stops it (SIGSTOP);
`worker.after_blob@3:kill` acts on the third pass. Several are separated by commas; names of other programs' points are
left alone. Points: `worker.after_claim`, `worker.after_blob`, `worker.before_complete`, `worker.after_complete`.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter

VARIABLE = "MAREY_FAULT"
SETTLE_S = 0.2
"""A stop reaches the threads of a process one by one; the one that asked for it must not run ahead."""
ACTIONS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}

_passes: Counter[str] = Counter()


def point(name: str) -> None:
    """Trigger the fault that the environment requests for this point, if any."""
    wanted = os.environ.get(VARIABLE)
    if not wanted:
        return
    _passes[name] += 1
    for text in wanted.split(","):
        place, _, action = text.partition(":")
        where, _, nth = place.partition("@")
        if where == name and action in ACTIONS and (not nth or int(nth) == _passes[name]):
            os.kill(os.getpid(), ACTIONS[action])
            time.sleep(SETTLE_S)
