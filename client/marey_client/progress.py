"""Progress of long work: functions that are called with the progress, and a progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marey_schemas.queue.jobs import Job

OnProgress = Callable[[str, int, int | None], None]
"""Function called with a text on the activity, the number of steps done, and their total, which is None if unknown."""

Advance = Callable[[str, float, float | None], None]
"""Function called with a text on the activity, the amount done, and the total amount, which is None if unknown."""


_bar = Lock()
"""Lock of the thread that shows a progress bar, because only one bar can be shown at a time."""


def ignore_progress(_doing: str, _done: float, _of: float | None) -> None:
    """Do nothing; used in place of a function that shows progress."""


def is_shown(shown: bool | None) -> bool:
    """Return whether a progress bar is shown: by default on terminals (standard error) and in notebooks."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules if shown is None else shown


@contextmanager
def progress(shown: bool | None = None) -> Iterator[Advance]:
    """Show a progress bar during the `with` block if `is_shown(shown)`; yield a function that updates the bar.

    Only one bar is shown at a time, because the bars of several threads would overwrite each other.
    """
    if not is_shown(shown) or not _bar.acquire(blocking=False):
        yield ignore_progress
        return
    try:
        with _new_bar() as advance:
            yield advance
    finally:
        _bar.release()


@contextmanager
def _new_bar() -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda what, done, total: bar.update(task, description=what, completed=done, total=total)


def show_progress(now: Job, advance: Advance, count: int | None = None, unit: str = "") -> None:
    """Report the progress of a job by calling `advance`.

    The progress of a job with tasks is counted in tasks, or, with `count`, scaled to this number of units called
    `unit`.
    """
    what = f"{now.kind} {now.state}"
    if now.progress is None:
        return advance(what, 0, None)
    if now.size is None or now.progress.total != now.size:
        return advance(now.progress.note or what, now.progress.done, now.progress.total)
    if count is None:
        return advance(what, now.progress.done, now.size)
    return advance(unit or what, round(now.progress.done / now.size * count), count)
