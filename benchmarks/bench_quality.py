"""Quality of clips, compared with loops of the published formulas."""

from __future__ import annotations

import numpy as np

from benchmarks.timing import Row, time_in_turn
from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.gait import generate_gait
from marey_motion.quality.feet import Feet, weighted_skate
from marey_motion.quality.measuring import QualityBody, measure_quality
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.options.quality import QualityOptions

OPTIONS = QualityOptions(rate_hz=60.0)
CLIPS, CLIP_S = 20, 60.0
GOAL_FRAMES_PER_S = 50_000
LOOP_GOAL = 20


def run() -> list[Row]:
    """Measure on one thread: all measures of many clips, and one measure compared with a plain loop of its formula."""
    return [_clips(), _weighted_skate()]


def _clips() -> Row:
    clip = generate_gait(1.4, 0.1, CLIP_S)
    mapping = map_joints(clip.skeleton)
    body = QualityBody.of(clip.skeleton, mapping, guess_axes(clip.skeleton, mapping))

    def measure() -> None:
        for _ in range(CLIPS):
            measure_quality(clip, body, OPTIONS)

    (ours,) = time_in_turn(measure, repeats=3)
    rate = CLIPS * clip.frame_count / ours.median_s
    goal = f"≥ {GOAL_FRAMES_PER_S:,} frames/s"
    size = f"{CLIPS} clips of {clip.frame_count:,} frames, {clip.skeleton.joint_count} joints"
    return Row(
        "all measures of quality", size, f"{rate:,.0f} frames/s", "none", None, goal, rate >= GOAL_FRAMES_PER_S
    )  # fmt: skip


def _weighted_skate() -> Row:
    clip = generate_gait(1.4, 0.1, CLIP_S)
    positions = kinematics.global_positions(clip).astype(np.float64)
    ankles, toes = (
        positions[:, [clip.skeleton.index_of(f"{side}{name}") for side in ("Left", "Right")]]
        for name in ("Foot", "ToeBase")
    )
    feet = Feet.of(ankles, toes, clip.frame_rate_hz, OPTIONS)
    assert abs(weighted_skate(feet, OPTIONS) - _by_loop(feet.points, feet.heights)) < 1e-9
    ours, theirs = time_in_turn(
        lambda: weighted_skate(feet, OPTIONS), lambda: _by_loop(feet.points, feet.heights), repeats=3
    )
    ratio = theirs.median_s / ours.median_s
    return Row(
        "foot skate, weighted by height", f"{clip.frame_count:,} frames", f"{ours.median_s * 1e3:.2f} ms",
        f"direct loop {theirs.median_s * 1e3:.0f} ms", ratio, f"≥ {LOOP_GOAL}x", ratio >= LOOP_GOAL,
    )  # fmt: skip


def _by_loop(points: Floats, heights: Floats) -> float:
    """Compute the formula of Zhang et al. as it is written: frame by frame, toe by toe."""
    found = []
    for frame in range(len(points) - 1):
        for toe in (2, 3):
            x, _, z = points[frame + 1, toe] - points[frame, toe]
            height = 0.5 * (heights[frame, toe] + heights[frame + 1, toe])
            share = min(max(height / OPTIONS.weighted_height_m, 0.0), 1.0)
            found.append(float(np.hypot(x, z)) * OPTIONS.rate_hz * (2.0 - 2.0**share))
    return float(np.mean(found))
