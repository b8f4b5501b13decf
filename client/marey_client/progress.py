"""Progress of long work with a dataset: archives, exports and copies of versions."""

from __future__ import annotations

from collections.abc import Callable

OnProgress = Callable[[str, int, int | None], None]
"""Function called with the current activity, the amount done, and the total amount if it is known."""


def ignore_progress(_doing: str, _done: int, _of: int | None) -> None:
    """Ignore a report of progress."""
