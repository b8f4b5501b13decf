"""Waits of tests for what is certain to happen, but may take long on a busy machine."""

import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 240.0
"""Longest wait in seconds: shorter than the time limit of a test, whose error says less."""


def wait_until(condition: Callable[[], Any], *, pause_s: float = 0.01) -> None:
    """Wait until a condition is true; fail after `PATIENCE_S`."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s"
        time.sleep(pause_s)
