"""Number of workers that a pool should have, from the depth of the queue.

The pool grows when jobs have waited for some seconds, and shrinks when it was larger than needed for minutes. So a
burst of short jobs starts no workers, and the end of each job does not stop one.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

SAMPLES_REMEMBERED = 1000
"""Greatest number of remembered samples; the oldest are forgotten first."""


@dataclass(frozen=True)
class PoolLimits:
    """Limits of a pool.

    Parameters
    ----------
    least, most : smallest and greatest number of workers
    slots : number of jobs that a worker runs at the same time
    grow_after_s : seconds for which jobs must have waited before a worker is started for them
    shrink_after_s : seconds for which workers must have been superfluous before they are stopped
    """

    least: int
    most: int
    slots: int = 1
    grow_after_s: float = 10.0
    shrink_after_s: float = 300.0


class PoolSize:
    """Decision on the number of workers, from the numbers of jobs in the last minutes."""

    def __init__(self, limits: PoolLimits) -> None:
        self._limits = limits
        self._samples: deque[tuple[float, int]] = deque(maxlen=SAMPLES_REMEMBERED)
        """Samples: a time, and the number of workers that the queue needed at this time."""
        self._since_s: float | None = None

    def decide(self, now_s: float, *, queued: int, running: int, present: int) -> int:
        """Return the number of workers that the pool should have now.

        Parameters
        ----------
        now_s : time of a monotonic clock, in seconds
        queued : number of jobs that wait for workers of the pool
        running : number of jobs that workers of the pool run
        present : number of workers that run or were started
        """
        limits = self._limits
        self._since_s = now_s if self._since_s is None else self._since_s
        self._samples.append((now_s, -(-(queued + running) // limits.slots)))
        while self._samples[0][0] < now_s - max(limits.grow_after_s, limits.shrink_after_s):
            self._samples.popleft()
        lowest = min(self._recent(now_s, limits.grow_after_s), default=0)
        highest = max(self._recent(now_s, limits.shrink_after_s), default=present)
        size = present
        if lowest > present:
            size = lowest
        elif highest < present:
            size = highest
        return min(max(size, limits.least), limits.most)

    def forget(self) -> None:
        """Forget all samples, for example because this process is no longer the leader."""
        self._samples.clear()
        self._since_s = None

    def _recent(self, now_s: float, seconds: float) -> list[int]:
        """Return the needed numbers of workers in the last `seconds`; empty if the samples do not cover this time."""
        if self._since_s is None or now_s - self._since_s < seconds:
            return []
        return [needed for at_s, needed in self._samples if at_s >= now_s - seconds]
