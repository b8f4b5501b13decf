"""Motion files of fifty megabytes, and the memory needed to read them, measured in a separate process."""

from __future__ import annotations

import random
import resource
from collections.abc import Callable
from pathlib import Path

from tests.support.motion_files import bvh

from marey_motion.errors import MotionError
from marey_motion.formats import ImportOptions, read_motion

MEGABYTE = 1 << 20
SIZE = 50 * MEGABYTE


def short_lines() -> bytes:
    return bvh([], frames=10) + b"0 0 0 0 0 0 0 0 0\n" * (SIZE // 18)


def long_numbers() -> bytes:
    line = b" ".join(b"0.12345678901234567891" for _ in range(9)) + b"\n"
    return bvh([], frames=10) + line * (SIZE // len(line))


def endless_hierarchy() -> bytes:
    return b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n" + b"JOINT b\n{\nOFFSET 0 0 0\n" * (SIZE // 24)


def one_line() -> bytes:
    return bvh([], frames=10) + b"0 " * (SIZE // 2)


def rubbish() -> bytes:
    return random.Random(0).randbytes(SIZE)


def read_and_measure(make: Callable[[], bytes], folder: str) -> None:
    """Read a file; write the outcome, and the memory used in addition to the file, to `folder`/result."""
    data = make()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    try:
        clip = read_motion(data, "big.bvh", options=ImportOptions(unit_scale_m=0.01)).clip
        outcome = f"read {0 if clip is None else clip.frame_count}"
    except MotionError as error:
        outcome = error.code
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    (Path(folder) / "result").write_text(f"{outcome}\n{used}")
