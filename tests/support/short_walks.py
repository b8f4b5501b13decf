"""Short walks as files."""

from __future__ import annotations

from pathlib import Path

from marey_client.imports import LocalFile, find_files
from marey_motion.clip import Clip
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_motion.gait.skeletons import STUDIO_STATURE_M


def write_short_walks(folder: Path, count: int) -> list[LocalFile]:
    """Write walks of 0.5 s on one skeleton as BVH files; each begins 1 cm away from the previous walk."""
    walk = generate_gait(1.0, 0.0, 0.5, 30)
    for number in range(count):
        poses = walk.poses.copy()
        poses[:, 0] += number / 100
        moved = Clip(walk.skeleton, walk.frame_rate_hz, poses, walk.translations, walk.translated_joints)
        (folder / f"walk-{number:03d}.bvh").write_bytes(write_bvh(moved))
    return list(find_files([folder]).files)


def write_named_walks(folder: Path, *names: str, seconds: float = 1.0, stature_m: float = STUDIO_STATURE_M) -> Path:
    """Write a walk for each name as a BVH file, each a little faster than the one before; return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        walk = generate_gait(1.0 + number / 10, 0.1, seconds, 30, stature_m=stature_m)
        (folder / f"{name}.bvh").write_bytes(write_bvh(walk))
    return folder
