"""Memory settings of a process: blocks that the C library keeps, and objects that the garbage collector skips."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager

KEPT_BLOCK_BYTES = 20 * 2**20
"""Size in bytes above which freed blocks are returned to the system at once; writing a clip as JSON takes 17 MB."""
KEPT_BYTES = 32 * 2**20
"""Number of free bytes at the end of a heap above which glibc returns them to the system; each thread has a heap."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc


def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next computation; has no effect with other C libraries.

    By default, glibc returns freed blocks of some 100 kB to the system at once and requests them again page by page.
    This doubles the time to read a clip.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, KEPT_BLOCK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)


@contextmanager
def loading_modules() -> Iterator[None]:
    """Turn the garbage collector off while modules are imported; afterwards, it skips the objects of these modules.

    These objects exist as long as the process. If the collector examined them, it would take a seventh of the time of
    all imports of the server.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
