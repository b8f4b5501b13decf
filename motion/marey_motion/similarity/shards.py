"""Shards: files with the features of many clips, which searches map into memory.

A row holds the features of one pose, a run the rows of one clip. A step consists of `STEP_ROWS` consecutive rows of a
run. A ball encloses the rows of `STEPS_PER_BALL` consecutive steps: it has a centre, and a radius for each vector and
rotation. A file begins with a magic number and the numbers of rows and balls. The centres and radii of all balls
follow, then the rows. A search reads all balls, but only a few of the rows.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags, Ints
from marey_motion.errors import MotionError
from marey_motion.similarity.features import JOINTS, ROTATED_JOINTS, VECTORS, WIDTH, PoseFeatures, Rows

STEP_ROWS = 3
"""Number of rows of a step (0.1 s). The compared poses of a window are a whole number of steps apart."""
STEPS_PER_BALL = 2
"""Number of steps of a ball. Larger balls are fewer and take less time to compare, but exclude fewer windows."""
FULL_SHARD_ROWS = 65_536
"""Number of rows of a full shard: 36 minutes of motion, about 43 MB."""
_MARK = b"mareyix1"
_HEAD = struct.Struct("<8sQQ")
_RADII = VECTORS + len(ROTATED_JOINTS)


class Runs(NamedTuple):
    """First row, first step and first ball of each of R runs in a shard, and the ends of the last run.

    A run contains the rows of one clip.

    Parameters
    ----------
    starts : (R + 1,) int64    run r has the rows [starts[r], starts[r + 1])
    firsts : (R + 1,) int64    run r has the steps [firsts[r], firsts[r + 1])
    balls : (R + 1,) int64    run r has the balls [balls[r], balls[r + 1])
    """

    starts: Ints
    firsts: Ints
    balls: Ints

    @classmethod
    def of(cls, lengths: Ints) -> Self:
        """Compute where runs of given lengths begin and end.

        Parameters
        ----------
        lengths : (R,) int64    numbers of rows of the runs

        Returns
        -------
        Runs    first row, step and ball of each run, and the ends of the last run
        """
        counts = np.concatenate(([0], lengths)).astype(np.int64)
        each = (counts, -(-counts // STEP_ROWS), -(-counts // (STEP_ROWS * STEPS_PER_BALL)))
        return cls(*map(np.cumsum, each))


@dataclass(frozen=True, eq=False)
class Shard:
    """Features of R runs, one for each clip, with their balls.

    Parameters
    ----------
    rows : (n, WIDTH) float32    features
    centres : (WIDTH, B) float32    centres of the balls
    radii : (41, B) float32    radii of the balls: of each vector, then of each rotation
    runs : Runs    where each run begins and ends
    joints : (R,) int64    joints of the skeleton of each clip, as encoded by `presence`
    """

    rows: Rows
    centres: Rows
    radii: Rows
    runs: Runs
    joints: Ints

    @classmethod
    def open(cls, path: Path, runs: Runs, joints: Ints) -> Self:
        """Map the file of a shard into memory.

        Parameters
        ----------
        path : Path    file that `write_shard` has written
        runs : Runs    where each run begins and ends
        joints : (R,) int64    joints of the skeleton of each clip, as encoded by `presence`

        Returns
        -------
        Shard    its arrays are read from the file when they are used

        Raises
        ------
        MotionError    if the file is not a shard, or if its numbers of rows and balls are not those of `runs`
        """
        with path.open("rb", buffering=0) as file:
            mapped = mmap(file.fileno(), 0, access=ACCESS_READ) if os.fstat(file.fileno()).st_size else b""
        mark, rows, balls = _HEAD.unpack(mapped[: _HEAD.size]) if len(mapped) >= _HEAD.size else (b"", 0, 0)
        size = _HEAD.size + 4 * (balls * (WIDTH + _RADII) + rows * WIDTH)
        if (mark, rows, balls, size) != (_MARK, runs.starts[-1], runs.balls[-1], len(mapped)):
            raise MotionError(
                f"the file of {len(mapped)} bytes is no shard of a motion index with {runs.starts[-1]} rows; build the "
                "index again",
                code="shard-damaged",
            )
        numbers: NDArray[np.float32] = np.frombuffer(mapped, "<f4", offset=_HEAD.size)
        table = numbers[: balls * (WIDTH + _RADII)].reshape(-1, balls)
        return cls(numbers[table.size :].reshape(-1, WIDTH), table[:WIDTH], table[WIDTH:], runs, joints)


def presence(features: PoseFeatures) -> int:
    """Encode which joints a clip's skeleton has as the bits of a number.

    Parameters
    ----------
    features : PoseFeatures    features of the clip

    Returns
    -------
    int    bit i is 1 if the skeleton has `JOINTS[i]`
    """
    return int(np.sum(features.present << np.arange(len(JOINTS))))


def joints_of(presence: int) -> Flags:
    """Decode which joints a skeleton has.

    Parameters
    ----------
    presence : int    result of the function `presence`

    Returns
    -------
    (15,) bool    which of `JOINTS` the skeleton has
    """
    return np.asarray(presence >> np.arange(len(JOINTS)) & 1 == 1)


def write_shard(path: Path, runs: Sequence[Rows]) -> None:
    """Write the file of a shard.

    Parameters
    ----------
    path : Path    file to write
    runs : sequence of (n, WIDTH) float32    features of each clip, at least one row each
    """
    from marey_motion.similarity.similarity_kernels import balls as fill_balls

    places = Runs.of(np.array([len(run) for run in runs]))
    rows = np.ascontiguousarray(np.concatenate(runs), "<f4")
    table = np.empty((WIDTH + _RADII, places.balls[-1]), "<f4")
    sizes = (STEP_ROWS * STEPS_PER_BALL, VECTORS, len(ROTATED_JOINTS))
    fill_balls(rows, places.starts, *sizes, table[:WIDTH], table[WIDTH:])
    with path.open("wb") as file:
        file.write(_HEAD.pack(_MARK, len(rows), table.shape[1]))
        _write(file, table)
        _write(file, rows)


def _write(file: Any, array: NDArray[Any]) -> None:
    file.write(array.data.cast("B"))
