"""Forward kinematics of 63 joints against pymotion, and retargeting from 31 to 63 joints, also with kept limbs."""

from __future__ import annotations

from functools import partial

import numpy as np
from pymotion.ops import skeleton as pymotion_skeleton

from benchmarks.material import captured_walk, noisy_clip, with_fingers
from benchmarks.timing import Row, time_in_turn
from marey_motion import kinematics
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.retargeting import RetargetPlan, plan_retarget, retarget, retarget_with_checks
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.options.retargeting import RetargetOptions

FRAMES, JOINTS = 10_000, 63
SOURCE_JOINTS = 31
KEPT_FRAMES = 2_000
GOAL = 25
GOAL_NS = 3.0
GOAL_POSES_PER_S = 50_000
PREDECESSOR_POSES_PER_S = 573


def run() -> list[Row]:
    """Measure Marey and pymotion, each on one thread."""
    return [_forward_kinematics(), _retargeting(), *_retargeting_with_kept_limbs()]


def _forward_kinematics() -> Row:
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
    return Row(
        "forward kinematics, per joint and frame",
        f"{FRAMES} frames x {JOINTS} joints",
        ours.shown(per_joint_ns, "ns", 2),
        f"pymotion {peer.shown(per_joint_ns, 'ns', 0)}",
        ratio,
        f"≥ {GOAL}x, ≤ {GOAL_NS:.0f} ns",
        ratio >= GOAL and ours.median_s * per_joint_ns <= GOAL_NS,
    )


def _retargeting() -> Row:
    clip = captured_walk(FRAMES, SOURCE_JOINTS)
    plan = _plan(clip.skeleton, with_fingers(game_skeleton(), JOINTS, "hand_l"))
    (timing,) = time_in_turn(lambda: retarget(clip, plan))
    return Row(
        "retargeting",
        f"{FRAMES} frames, {SOURCE_JOINTS} to {JOINTS} joints, {len(plan.pairs)} of them mapped",
        f"{FRAMES / timing.median_s:,.0f} poses/s",
        f"the predecessor's, as measured elsewhere: {PREDECESSOR_POSES_PER_S} poses/s",
        FRAMES / timing.median_s / PREDECESSOR_POSES_PER_S,
        f"≥ {GOAL_POSES_PER_S:,} poses/s",
        FRAMES / timing.median_s >= GOAL_POSES_PER_S,
    )


def _retargeting_with_kept_limbs() -> list[Row]:
    """Measure retargeting of a walk whose planted feet, hands, or both are kept by inverse kinematics."""
    clip = generate_gait(1.3, 0.1, KEPT_FRAMES / 60.0, 60.0)
    plan = _plan(clip.skeleton, game_skeleton())
    rows = []
    for name, options in (
        ("kept feet", RetargetOptions(keep_feet=True)),
        ("kept hands", RetargetOptions(keep_hands=True)),
        ("kept feet and hands", RetargetOptions(keep_feet=True, keep_hands=True)),
    ):
        (timing,) = time_in_turn(partial(retarget_with_checks, clip, plan, options), repeats=3)
        rows.append(
            Row(
                f"retargeting, {name}",
                f"{KEPT_FRAMES} frames, {len(plan.pairs)} mapped joints",
                f"{KEPT_FRAMES / timing.median_s:,.0f} poses/s",
            )
        )
    return rows


def _plan(source: Skeleton, target: Skeleton) -> RetargetPlan:
    mappings = [map_joints(skeleton) for skeleton in (source, target)]
    axes = [guess_axes(skeleton, mapping) for skeleton, mapping in zip((source, target), mappings, strict=True)]
    return plan_retarget(source, mappings[0], axes[0], target, mappings[1], axes[1])
