"""Dynamic time warping and alignment of whole sets, compared with librosa, tslearn, dtw-python and published times."""

from __future__ import annotations

from collections.abc import Callable

import dtw as dtw_python
import librosa
import numpy as np
import tslearn.metrics
from numpy.typing import NDArray

from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion import quaternions
from marey_motion.alignment.aligning import SourceExample, align_clips
from marey_motion.alignment.cost import frame_costs
from marey_motion.alignment.dtw import align
from marey_motion.alignment.reference import MOST_COMPARED
from marey_motion.alignment.warp import warped
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.options.alignment import AlignOptions, CostOptions

Floats = NDArray[np.float64]

# Frames of both motions, points, repeats, calls in each: a call by itself takes as long as finding its code again.
SIZES = ((200, 205, 20, 9, 20), (200, 205, 78, 9, 20), (1000, 1000, 63, 5, 2))
GOAL_RATIO = 3
GOAL_MS = 5
RANDOM_MATRICES = 100

# Clips of a set, repeats and goal in seconds, if there is one: the time must not grow with the square of the clips.
SETS = ((50, 3, None), (200, 3, None), (800, 1, 10.0), (5000, 1, 120.0))

# What the published system took, on two cores of the same kind: 200 x 205 frames of 78 points with an approximate DTW,
# point clouds included, and 30 clips of 42 to 53 frames aligned with a reference that was given.
PUBLISHED_PAIR_S = 2.9 + 0.79
PUBLISHED_SET_S = 12.7


def run() -> list[Row]:
    """Measure on one thread. Other libraries must find the same totals, but may choose other paths of equal cost."""
    _require_same_totals()
    rows = [row for size in SIZES for row in _pair(*size)]
    return [*rows, _published_pair(), _published_set(), *(_large_set(*size) for size in SETS)]


def _require_same_totals() -> None:
    random = np.random.default_rng(0)
    for _ in range(RANDOM_MATRICES):
        costs = random.random(random.integers(2, 60, 2))
        ours = align(costs).total
        for name, theirs in _peers_given_costs(costs).items():
            found = theirs()
            assert abs(found - ours) <= 1e-9 * ours, f"{name} finds {found}, we find {ours}"


def _peers_given_costs(costs: Floats) -> dict[str, Callable[[], float]]:
    """Return, by library, a function that computes the cheapest path for these costs and returns the total cost."""
    return {
        "librosa": lambda: float(librosa.sequence.dtw(C=costs)[0][-1, -1]),
        "dtw-python": lambda: float(dtw_python.dtw(costs, step_pattern="symmetric1").distance),
    }


def _peers_of_points(a: Floats, b: Floats) -> dict[str, Callable[[], float]]:
    """Return, by library, a function that computes costs and the cheapest path, and returns the total cost.

    The costs are squared distances between the points of a frame of `a` and of `b`, as flat vectors.
    """
    return {
        "librosa": lambda: float(librosa.sequence.dtw(a.T, b.T, metric="sqeuclidean")[0][-1, -1]),
        "dtw-python": lambda: float(
            dtw_python.dtw(a, b, dist_method="sqeuclidean", step_pattern="symmetric1").distance
        ),
        "tslearn": lambda: float(tslearn.metrics.dtw_path(a, b)[1] ** 2),
    }


def _clouds(frames: int, points: int, seed: int) -> Floats:
    random = np.random.default_rng(seed)
    return np.asarray(random.normal(size=(points, 3)) + random.normal(size=(frames, points, 3)).cumsum(axis=0) * 0.03)


def _pair(frames: int, others: int, points: int, repeats: int, calls: int) -> list[Row]:
    a, b = _clouds(frames, points, 1), _clouds(others, points, 2)
    size = f"{frames} x {others}, {points} points"
    plain = CostOptions(cost="plain")
    costs = frame_costs(a, b, plain)
    given = _peers_given_costs(costs)
    of_points = _peers_of_points(a.reshape(frames, -1), b.reshape(others, -1))
    total = align(costs).total
    for name, theirs in of_points.items():
        found = theirs() / points
        assert abs(found - total) <= 1e-9 * total, f"{name} finds {found}, we find {total}"
    return [
        _against("DTW given the costs", size, lambda: align(costs), given, repeats, calls, GOAL_RATIO),
        _against("plain costs and DTW", size, lambda: align(frame_costs(a, b, plain)), of_points, repeats, calls),
    ]


def _against(
    job: str,
    size: str,
    ours: Callable[[], object],
    peers: dict[str, Callable[[], float]],
    repeats: int,
    calls: int,
    goal: float | None = None,
) -> Row:
    """Time a function of Marey and its peers; return a row with the ratio to librosa, the fastest peer."""
    own, *theirs = _each(calls, repeats, ours, *peers.values())
    by_name = dict(zip(peers, theirs, strict=True))
    ratio = by_name["librosa"].median_s / own.median_s
    shown = ", ".join(f"{name} {timing.median_s * 1e3:.2f}" for name, timing in by_name.items())
    if goal is None:
        return Row(job, size, _ms(own), shown, ratio)
    return Row(job, size, _ms(own), shown, ratio, f"≥ {goal:g}x librosa", ratio >= goal)


def _each(calls: int, repeats: int, *contenders: Callable[[], object]) -> list[Timing]:
    """Call each function `calls` times in a row, repeatedly; return the time of one call of each function."""

    def many(call: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(calls):
                call()

        return run

    timings = time_in_turn(*map(many, contenders), repeats=repeats)
    return [Timing(one.best_s / calls, one.median_s / calls) for one in timings]


def _published_pair() -> Row:
    a, b = _clouds(200, 78, 3), _clouds(205, 78, 4)
    (ours,) = _each(10, 9, lambda: align(frame_costs(a, b), max_run=3))
    return Row(
        "turned costs and DTW with slope limit",
        "200 x 205, 78 points",
        _ms(ours),
        f"published system {PUBLISHED_PAIR_S * 1e3:,.0f} (stated)",
        PUBLISHED_PAIR_S / ours.median_s,
        f"≤ {GOAL_MS} ms",
        ours.median_s * 1e3 <= GOAL_MS,
    )


def _published_set() -> Row:
    examples, body = _examples(30, (42, 53))
    options = AlignOptions(reference=examples[0].uid)
    (ours,) = time_in_turn(lambda: align_clips(examples, body, options), repeats=5)
    return Row(
        "aligning clips with a given reference",
        f"30 clips of 42 to 53 frames, {body.skeleton.joint_count} joints",
        _ms(ours),
        f"published system {PUBLISHED_SET_S * 1e3:,.0f} (stated, 78 joints)",
        PUBLISHED_SET_S / ours.median_s,
    )


def _large_set(count: int, repeats: int, goal_s: float | None) -> Row:
    examples, body = _examples(count, (40, 60))
    (ours,) = time_in_turn(lambda: align_clips(examples, body), repeats=repeats)
    compared = min(count, MOST_COMPARED)
    pairs = compared * (compared - 1) // 2
    return Row(
        "aligning clips with their medoid",
        f"{count:,} clips of 40 to 60 frames, {body.skeleton.joint_count} joints",
        ours.shown(1.0, "s", 2),
        f"{pairs:,} pairs compared",
        None,
        "" if goal_s is None else f"≤ {goal_s:g} s",
        None if goal_s is None else ours.median_s <= goal_s,
    )


def _examples(count: int, frames: tuple[int, int]) -> tuple[list[SourceExample], MatchingBody]:
    """Return variants of one walk, and the body of the walker.

    The variants differ in timing, by a sine of up to 0.08 of the duration. They also differ in the scale of the root's
    path (0.9 to 1.1), and in a random drift of the joint rotations (0.002 per frame).
    """
    random = np.random.default_rng(5)
    walk = generate_gait(1.3, 0.2, 50 / 60)
    motion = Motion.of(walk)
    examples = []
    for number in range(count):
        share = np.linspace(0.0, 1.0, int(random.integers(frames[0], frames[1] + 1)))
        depth = random.uniform(-0.08, 0.08)
        times = np.clip(share + depth * np.sin(2.0 * np.pi * share), 0.0, 1.0) * (motion.frame_count - 1)
        one = warped(motion, times)
        drift = random.normal(0.0, 0.002, one.rotations.shape).cumsum(axis=0)
        rotations = np.asarray(quaternions.normalise(one.rotations + drift), dtype=np.float64)
        scaled = one._replace(root_translations=one.root_translations * random.uniform(0.9, 1.1), rotations=rotations)
        clip = scaled.as_clip(walk.skeleton, 60.0)
        examples.append(SourceExample(f"clip_{number:03d}@1", f"walk {number}", clip))
    return examples, MatchingBody.from_mapping(walk.skeleton, map_joints(walk.skeleton))


def _ms(timing: Timing) -> str:
    return timing.shown(1e3, "ms", 2)
