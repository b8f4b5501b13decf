"""Bytes per pose of stored clips, compared with common formats, and the speed of the block encoding."""

from __future__ import annotations

import bson
import numpy as np
import zstandard
from numpy.typing import NDArray

from benchmarks.material import noisy_clip
from benchmarks.timing import Row, time_in_turn
from marey_schemas.encoding import blocks

FRAMES = 3000
GOAL_BYTES, GOAL_ENCODING_MB_PER_S = 450, 150


def run() -> list[Row]:
    """Measure float32 poses, which are stored exactly, with 63 and with 31 joints."""
    rows = []
    for joints in (63, 31):
        poses = noisy_clip(FRAMES, joints).poses
        rows.append(_size_row(poses, joints))
    rows += _speed_rows(noisy_clip(FRAMES, 63).poses)
    return rows


def _size_row(poses: NDArray[np.float32], joints: int) -> Row:
    encoded = blocks.encode(poses)
    assert np.array_equal(blocks.decode(encoded).view(np.uint32), poses.view(np.uint32)), "the codec must be exact"
    ours = len(encoded) / len(poses)
    doubles = len(bson.encode({"poses": poses.astype(np.float64).tolist()})) / len(poses)
    squeezed = len(zstandard.ZstdCompressor(level=1).compress(poses.tobytes())) / len(poses)
    return Row(
        "stored bytes per pose",
        f"{FRAMES} frames x {joints} joints, synthetic capture noise",
        f"{ours:.0f} B",
        f"BSON of doubles {doubles:.0f} B; zstd of float32 {squeezed:.0f} B",
        doubles / ours,
        f"≤ {GOAL_BYTES} B" if joints == 63 else "",
        ours <= GOAL_BYTES if joints == 63 else None,
    )


def _speed_rows(poses: NDArray[np.float32]) -> list[Row]:
    encoded = blocks.encode(poses)
    encoding, decoding = time_in_turn(lambda: blocks.encode(poses), lambda: blocks.decode(encoded))
    megabytes = poses.size * 8 / 1e6  # counted as doubles, as the measured peers were
    size = f"{FRAMES} frames x 63 joints, MB of doubles"
    return [
        Row(
            "encode blocks",
            size,
            f"{megabytes / encoding.median_s:.0f} MB/s",
            goal=f"≥ {GOAL_ENCODING_MB_PER_S} MB/s",
            met=megabytes / encoding.median_s >= GOAL_ENCODING_MB_PER_S,
        ),
        Row("decode blocks", size, f"{megabytes / decoding.median_s:.0f} MB/s"),
    ]
