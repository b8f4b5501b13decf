"""Motion files of many megabytes, and the memory needed to read them, measured in a separate process."""

from __future__ import annotations

import random
import resource
from collections.abc import Callable
from pathlib import Path

from tests.support.motion_files import bvh

from marey_motion.errors import MotionError
from marey_motion.formats import ImportOptions, read_motion

MEGABYTE = 1 << 20


def short_lines(size: int) -> bytes:
    return bvh([], frames=10) + b"0 0 0 0 0 0 0 0 0\n" * (size // 18)


def long_numbers(size: int) -> bytes:
    line = b" ".join(b"0.12345678901234567891" for _ in range(9)) + b"\n"
    return bvh([], frames=10) + line * (size // len(line))


def endless_hierarchy(size: int) -> bytes:
    return b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n" + b"JOINT b\n{\nOFFSET 0 0 0\n" * (size // 24)


def one_line(size: int) -> bytes:
    return bvh([], frames=10) + b"0 " * (size // 2)


def rubbish(size: int) -> bytes:
    return random.Random(0).randbytes(size)


def read_and_measure(make: Callable[[int], bytes], size: int, folder: str) -> None:
    """Read a file of about `size` bytes; write the outcome and the memory used for reading to `folder`/result."""
    data = make(size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    try:
        clip = read_motion(data, "big.bvh", options=ImportOptions(unit_scale_m=0.01)).clip
        outcome = f"read {0 if clip is None else clip.frame_count}"
    except MotionError as error:
        outcome = error.code
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    (Path(folder) / "result").write_text(f"{outcome}\n{used}")
