"""Forward kinematics of 63 joints against pymotion."""

from __future__ import annotations

import numpy as np
from pymotion.ops import skeleton as pymotion_skeleton

from benchmarks.material import noisy_clip
from benchmarks.timing import Row, time_in_turn
from marey_motion import kinematics

FRAMES, JOINTS = 10_000, 63
GOAL = 25


def run() -> list[Row]:
    """Positions of every joint in every frame, one thread."""
    clip = noisy_clip(FRAMES, JOINTS)
    rotations = np.ascontiguousarray(clip.rotations)
    root = np.ascontiguousarray(clip.root_translations)
    offsets, parents = clip.skeleton.offsets.astype(np.float32), clip.skeleton.parents.copy()
    parents[0] = 0  # pymotion's mark of the root

    theirs, _ = pymotion_skeleton.fk(rotations, root, offsets, parents)
    difference = float(np.abs(kinematics.global_positions(clip) - theirs).max())
    assert difference < 1e-4, f"joint positions differ by {difference} m"

    ours, peer = time_in_turn(
        lambda: kinematics.global_positions(clip),
        lambda: pymotion_skeleton.fk(rotations, root, offsets, parents),
    )
    per_joint_ns = 1e9 / (FRAMES * JOINTS)
    ratio = peer.median_s / ours.median_s
    return [
        Row(
            "forward kinematics",
            f"{FRAMES} frames x {JOINTS} joints",
            f"{ours.median_s * per_joint_ns:.2f} ns/joint·frame",
            f"pymotion {peer.median_s * per_joint_ns:.0f} ns",
            ratio,
            f"≥ {GOAL}x, ≤ 3 ns",
            ratio >= GOAL,
        )
    ]
