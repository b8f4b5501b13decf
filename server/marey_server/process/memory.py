"""How the process keeps memory that it has freed.

Of its own accord glibc returns blocks of some 100 kB to the system as soon as they are freed, and gets them back page
by page: for clips, that takes as long as all else that reading one takes.
"""

from __future__ import annotations

import ctypes

KEPT_BLOCK_BYTES = 8 * 2**20
"""Larger blocks are returned at once."""
KEPT_BYTES = 32 * 2**20
"""More than this at the end of a heap is returned; threads have heaps of their own."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc


def keep_freed_memory() -> None:
    """Keep what was freed for the next request. Only glibc is told; other allocators have ways of their own."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, KEPT_BLOCK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
