"""Threads in which the server process decodes, checks, packs and renders documents, and reads and writes files.

Long computations, and computations that need numeric modules, run in child processes.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future
from typing import ParamSpec, TypeVar

from marey_server.store.database.lanes import SERVER, Client, Lane

P = ParamSpec("P")
T = TypeVar("T")

THREAD_NAME = "marey-compute"
RENDERING_THREADS = 3
"""Number of threads that render documents; one client, or all clients without a known token, may use all but one."""
HOUSEKEEPING_THREADS = 3
"""Number of threads for housekeeping, one each for large commits, waiting merges, and garbage collection."""
BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ComputeThreads:
    """Threads of the server process, in three lanes (threads with a queue of computations).

    The first lane computes for requests. One client may use as many threads of this lane as there are processors, but
    at least two. The same limit applies to all clients without a known token together. One more thread of the lane is
    always left to other clients. The second lane encodes answers. The third lane is for the long computations of
    housekeeping, which would otherwise delay requests.
    """

    def __init__(self, threads: int | None = None) -> None:
        most_each = max(2, threads or os.cpu_count() or 2)
        self._lane = Lane(THREAD_NAME, most_each + 1, most_each=most_each)
        self.rendering = Lane(f"{THREAD_NAME}-rendering", RENDERING_THREADS, most_each=RENDERING_THREADS - 1)
        self._housekeeping = Lane(f"{THREAD_NAME}-housekeeping", HOUSEKEEPING_THREADS)

    @property
    def lanes(self) -> dict[str, Lane]:
        """The lanes by name."""
        return {"computing": self._lane, "rendering": self.rendering, "housekeeping": self._housekeeping}

    def submit(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a computation or file access of the server itself in a thread; return the future of its result."""
        return self._lane.submit(SERVER, function, *args, **kwargs)

    def submit_housekeeping(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a computation of housekeeping in a thread; return the future of its result."""
        return self._housekeeping.submit(SERVER, function, *args, **kwargs)

    def submit_for(self, client: Client, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a computation for a client in a thread; return the future of its result.

        Raises `UnavailableProblem` if too many computations wait.
        """
        return self._lane.submit(client, function, *args, **kwargs)

    def close(self) -> None:
        """Start no more computations. Do not wait for running computations, because their clients have disconnected."""
        self._lane.close(wait=False)
        self.rendering.close(wait=False)
        self._housekeeping.close(wait=False)


def compute_on_one_thread_each() -> None:
    """Limit the threads of numeric libraries to one for each computation, because computations run in parallel."""
    from threadpoolctl import threadpool_limits

    for name in BLAS_VARIABLES:  # for libraries that are not loaded yet
        os.environ.setdefault(name, "1")
    threadpool_limits(1)


def leave() -> None:
    """End this process at once, without waiting for running computations and without freeing its objects.

    Nobody waits for the computations, because their clients have disconnected. Freeing all objects would take 0.3 s.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
