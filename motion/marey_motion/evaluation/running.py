"""Work on many trials at a time: threads, progress and cancellation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

from marey_motion.errors import MotionError

ProgressCallback = Callable[[int, int, str], None]
CancelCallback = Callable[[], bool]
Item = TypeVar("Item")
Made = TypeVar("Made")


class EvaluationCancelled(MotionError):
    """The evaluation was cancelled; finished runs were reported to the caller."""

    default_code = "evaluation-cancelled"


def run_each(
    run: Callable[[Item], Made],
    items: Sequence[Item],
    keep: Callable[[Item, Made], None],
    threads: int,
    cancelled: CancelCallback,
) -> None:
    """Call a function for many items on several threads, and pass each result to `keep` as soon as it is ready.

    Parameters
    ----------
    run : callable    called with one item, in a worker thread
    items : sequence    the items
    keep : callable    called with each item and its result, in the calling thread
    threads : int    number of items that are processed at a time
    cancelled : callable    called before items are started, until it returns True to stop

    Raises
    ------
    EvaluationCancelled    if cancelled; items that are running are finished first
    """
    waiting = list(reversed(range(len(items))))
    running: dict[Future[Made], int] = {}
    stopping = False
    with ThreadPoolExecutor(max_workers=threads, thread_name_prefix="trial") as pool:
        while waiting or running:
            stopping = stopping or (bool(waiting) and cancelled())
            while waiting and not stopping and len(running) < threads:
                number = waiting.pop()
                running[pool.submit(run, items[number])] = number
            if stopping and not running:
                raise EvaluationCancelled(
                    f"the evaluation was stopped; {len(waiting)} of {len(items)} runs were not made"
                )
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(ended, key=running.__getitem__):
                keep(items[running.pop(future)], future.result())
