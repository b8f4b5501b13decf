"""Perceptual distances, compared with distances of scipy and with a direct loop of the paper's formulas."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from benchmarks.timing import Row, time_in_turn
from marey_motion.arrays import Floats
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception.fitting import PairDifferences, bootstrap_weights
from marey_motion.perception.judging import difference_table, pair_counts_by_participant, simulate_judgements
from marey_motion.perception.maps import motion_map
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import PerceptualMetric, metric_of
from marey_motion.perception.registration import clip_distance
from marey_motion.rigs import map_joints
from marey_schemas.documents.metrics import built_in_metric, classes_of

GOAL_RATIO = 20
MAP_FRAMES, LOOP_FRAMES, CYCLE_FRAMES = 2_000, 60, 66
MOTIONS, PARTICIPANTS, BOOTSTRAPS = 21, 29, 1_000


def run() -> list[Row]:
    """Measure on one thread; all peers must find the same distances."""
    positions = metric_of(built_in_metric("published/positions-manhattan"))
    return [_map(positions), _loop(positions), _all_measurements(), *_clips(positions), _bootstraps()]


def _walk(frames: int, speed: float) -> MeasuredClip:
    clip = generate_gait(speed, 0.1, frames / 60.0 + 0.1)
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    return measure_motion(Motion.of(clip), body, 60.0).at(np.arange(float(frames)))


def _points(clip: MeasuredClip, metric: PerceptualMetric) -> list[tuple[float, Floats]]:
    """Return weight and positions (F, 3) of each point of the classes; the sides of a class share its weight."""
    (component,) = metric.components
    shares = component.shares_of(clip.classes)
    counts = np.diff(clip.starts)
    weights = np.repeat(shares / counts, counts)
    return [(float(weight), clip.positions[:, point]) for point, weight in enumerate(weights) if weight > 0.0]


def _by_scipy(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> Floats:
    pairs = zip(_points(a, metric), _points(b, metric), strict=True)
    found = sum(weight * cdist(one, other) for (weight, one), (_, other) in pairs)
    (component,) = metric.components
    return np.asarray(component.constant * (np.asarray(found) > 0.0) + component.norm * found, dtype=np.float64)


def _by_loop(a: MeasuredClip, b: MeasuredClip, metric: PerceptualMetric) -> Floats:
    """Compute equation 2 of the paper as it is written: frame by frame, joint by joint."""
    ones, others = _points(a, metric), _points(b, metric)
    (component,) = metric.components
    found = np.empty((a.frame_count, b.frame_count))
    for i in range(a.frame_count):
        for j in range(b.frame_count):
            total = 0.0
            for (weight, one), (_, other) in zip(ones, others, strict=True):
                total += weight * float(np.sqrt(np.sum((one[i] - other[j]) ** 2)))
            found[i, j] = component.constant * (total > 0.0) + component.norm * total
    return found


def _map(metric: PerceptualMetric) -> Row:
    a, b = _walk(MAP_FRAMES, 1.2), _walk(MAP_FRAMES, 1.6)
    np.testing.assert_allclose(motion_map(a, b, metric), _by_scipy(a, b, metric), rtol=1e-9)
    ours, theirs = time_in_turn(lambda: motion_map(a, b, metric), lambda: _by_scipy(a, b, metric), repeats=3)
    size = f"{MAP_FRAMES:,} x {MAP_FRAMES:,} frames"
    return Row(
        "motion map by positions", size, f"{ours.median_s * 1e3:.0f} ms",
        f"scipy cdist per joint {theirs.median_s * 1e3:.0f} ms", theirs.median_s / ours.median_s,
    )  # fmt: skip


def _loop(metric: PerceptualMetric) -> Row:
    a, b = _walk(LOOP_FRAMES, 1.2), _walk(LOOP_FRAMES, 1.6)
    np.testing.assert_allclose(motion_map(a, b, metric), _by_loop(a, b, metric), rtol=1e-9)
    ours, theirs = time_in_turn(lambda: motion_map(a, b, metric), lambda: _by_loop(a, b, metric), repeats=3)
    ratio = theirs.median_s / ours.median_s
    return Row(
        "motion map by positions", f"{LOOP_FRAMES} x {LOOP_FRAMES} frames", f"{ours.median_s * 1e3:.2f} ms",
        f"direct loop {theirs.median_s * 1e3:.0f} ms", ratio, f"≥ {GOAL_RATIO}x", ratio >= GOAL_RATIO,
    )  # fmt: skip


def _all_measurements() -> Row:
    metric = metric_of(built_in_metric("published/sigmoid"))
    a, b = _walk(MAP_FRAMES, 1.2), _walk(MAP_FRAMES, 1.6)
    (ours,) = time_in_turn(lambda: motion_map(a, b, metric), repeats=3)
    size = f"{MAP_FRAMES:,} x {MAP_FRAMES:,} frames"
    return Row("motion map by all measurements", size, f"{ours.median_s * 1e3:.0f} ms", "none", None)


def _clips(metric: PerceptualMetric) -> list[Row]:
    """Time the distance of two clips; the peers compute only both motion maps, without registration curves."""
    from dataclasses import replace

    a, b = (replace(_walk(CYCLE_FRAMES, speed), cyclic=True) for speed in (1.2, 1.6))

    def loops() -> None:
        _by_loop(a, b, metric)
        _by_loop(b, a, metric)

    def by_scipy() -> None:
        _by_scipy(a, b, metric)
        _by_scipy(b, a, metric)

    ours, theirs, scipys = time_in_turn(lambda: clip_distance(a, b, metric), loops, by_scipy, repeats=3)
    ratio = theirs.median_s / ours.median_s
    measured = "distance of two loops, all shifts", f"{CYCLE_FRAMES} frames", f"{ours.median_s * 1e3:.1f} ms"
    return [
        Row(*measured, f"direct loop, maps alone {theirs.median_s * 1e3:.0f} ms", ratio, f"≥ {GOAL_RATIO}x",
            ratio >= GOAL_RATIO),
        Row(*measured, f"scipy cdist, maps alone {scipys.median_s * 1e3:.1f} ms", scipys.median_s / ours.median_s),
    ]  # fmt: skip


def _bootstraps() -> Row:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(MOTIONS, 2))
    truth = np.linalg.norm(points[:, None] - points, axis=-1) / 6.0
    judged = simulate_judgements(truth, PARTICIPANTS, seed=1, noise=0.05)
    first, second = np.triu_indices(MOTIONS, 1)
    classes = classes_of("positions")
    frames = tuple(
        rng.gamma(4.0, truth[i, j] / 40.0, size=(120, len(classes))) for i, j in zip(first, second, strict=True)
    )
    pairs = PairDifferences("positions", classes, np.stack((first, second), axis=1), frames)
    shown, chosen = pair_counts_by_participant(judged)
    assert np.isfinite(difference_table(judged).differences).all()
    (ours,) = time_in_turn(lambda: bootstrap_weights(pairs, shown, chosen, "manhattan", draws=BOOTSTRAPS), repeats=1)
    size = f"{len(first)} pairs, {BOOTSTRAPS:,} draws of participants"
    return Row("fit of weights with intervals", size, f"{ours.median_s:.2f} s", "none", None)
