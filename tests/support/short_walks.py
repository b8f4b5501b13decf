"""Many short walks as files, which differ only in position: generating different walks would take twice as long."""

from __future__ import annotations

from pathlib import Path

from marey_client.imports import LocalFile, find_files
from marey_motion.clip import Clip
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait


def write_short_walks(folder: Path, count: int) -> list[LocalFile]:
    """Write walks of 0.5 s on one skeleton as BVH files; each begins 1 cm away from the previous walk."""
    walk = generate_gait(1.0, 0.0, 0.5, 30)
    for number in range(count):
        poses = walk.poses.copy()
        poses[:, 0] += number / 100
        moved = Clip(walk.skeleton, walk.frame_rate_hz, poses, walk.translations, walk.translated_joints)
        (folder / f"walk-{number:03d}.bvh").write_bytes(write_bvh(moved))
    return list(find_files([folder]).files)
