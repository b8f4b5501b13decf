"""Limits that a child process sets for itself, termination of the child when its parent ends, and measurement of its
memory.
"""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import sys

import psutil

PR_SET_PDEATHSIG = 1
OUT_OF_MEMORY = 86
"""Exit status of a child that could not allocate the memory for a message; no other end has this status."""
_COUNTERS = "/proc/vmstat"


def die_with_parent() -> None:
    """Make the kernel kill this process when the thread that started it ends.

    On other systems than Linux, the child ends at its next message, because the pipe is closed.
    """
    if sys.platform != "linux":
        return
    parent = os.getppid()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def allow_memory(limit_bytes: int | None) -> None:
    """Let this process allocate at most `limit_bytes` more than it has now; None removes the limit.

    An allocation beyond the limit raises `MemoryError` at once, before the machine runs out of memory.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    soft = resource.RLIM_INFINITY if limit_bytes is None else psutil.Process().memory_info().vms + limit_bytes
    if hard != resource.RLIM_INFINITY:
        soft = hard if soft == resource.RLIM_INFINITY else min(soft, hard)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def allow_mapped_files(more_bytes: int) -> None:
    """Raise the limit of `allow_memory` by `more_bytes`, or lower it if they are negative; has no effect without limit.

    Files that are mapped only to be read count for this limit, although the system can take back their memory at any
    time.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if soft != resource.RLIM_INFINITY:
        wanted = soft + more_bytes
        resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def allow_processor_time(seconds: float) -> None:
    """Let this process use at most `seconds` of further processor time; beyond that, the kernel sends SIGXCPU.

    The limit has a resolution of one second, and is rounded up.
    """
    used = resource.getrusage(resource.RUSAGE_SELF)
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(used.ru_utime + used.ru_stime + seconds), hard))


def count_memory_kills() -> int:
    """Return how many processes the kernel has killed since the machine started, because memory was used up.

    Return 0 on systems other than Linux.
    """
    try:
        with open(_COUNTERS, encoding="ascii") as counters:
            return next((int(line.split()[1]) for line in counters if line.startswith("oom_kill ")), 0)
    except FileNotFoundError:
        return 0


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process and its descendants, in bytes; 0 if the process has ended."""
    try:
        process = psutil.Process(pid)
        family = [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return 0
    total = 0
    for member in family:
        try:
            total += member.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total
