"""Searches by example: features, exactness against brute force, overlaps, mirrored examples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.formats import read_motion
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.mirroring import mirror_clip
from marey_motion.motion import Motion
from marey_motion.perception.maps import paired_distances
from marey_motion.perception.measuring import measure_motion
from marey_motion.perception.metric import PerceptualMetric, metric_of, published_metric
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.similarity.example import Example, sample_offsets
from marey_motion.similarity.features import (
    INDEX_RATE_HZ,
    JOINTS,
    ROTATIONS_AT,
    WIDTH,
    PoseFeatures,
    clip_features,
    mirrored,
)
from marey_motion.similarity.searching import Hit, search_clips, search_windows
from marey_motion.similarity.shard_search import SearchedShard
from marey_motion.similarity.shards import Runs, Shard, presence, write_shard
from marey_motion.similarity.similarity_kernels import pose_distance as pose_distance_kernel
from marey_motion.similarity.weighing import metric_tables
from marey_schemas.documents.metrics import AngleMeasure, built_in_metric

ALL = (1 << len(JOINTS)) - 1


def features_of(clip: Clip) -> PoseFeatures:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    return clip_features(Motion.of(clip), body, clip.frame_rate_hz)


def searched(
    folder: Path, runs: list[np.ndarray], *, present: list[int] | None = None, name: str = "s"
) -> SearchedShard:
    bits, lengths = np.array(present or [ALL] * len(runs)), np.array([len(run) for run in runs])
    write_shard(folder / name, runs)
    path, places = folder / name, Runs.of(lengths)
    return SearchedShard(lambda: Shard.open(path, places, bits), np.arange(len(runs)), np.zeros(len(runs), np.bool_))


def pose_distance(a: np.ndarray, b: np.ndarray, metric: PerceptualMetric) -> float:
    """Compute the distance of two rows from the formulas of the metric, for all joints, in plain numpy."""
    vectors = [np.linalg.norm(np.float64(a[:90]).reshape(30, 3) - np.float64(b[:90]).reshape(30, 3), axis=1)]
    one, other = np.float64(a[90:]).reshape(11, 4), np.float64(b[90:]).reshape(11, 4)
    chord = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    angles, positions = 2 * np.arcsin(np.minimum(chord / 2, 1)), vectors[0][:15]
    measured = {"angles": angles, "positions": positions, "velocities": vectors[0][15:] / 30}
    sides = {"head": [0], "clavicle": [1, 2], "upper_arm": [3, 4], "forearm": [5, 6], "hand": [7, 8]}
    legs = {"thigh": [9, 10], "calf": [11, 12], "toe": [13, 14]}
    total = 0.0
    for share, part in zip(metric.shares, metric.components, strict=True):
        raw, weights = 0.0, sum(part.weights.values())
        for joint, weight in part.weights.items():
            at = np.array({**sides, **legs}[joint])
            at = at - 2 if part.measurement == "angles" and joint in legs else at
            x = float(measured[part.measurement][at].mean())
            raw += weight / weights * {"euclid": x * x, "manhattan": x, "sigmoid": x / (x + 1)}[part.shaping]
        total += share * (part.norm * raw + part.constant * (raw > 0))
    return total


def by_brute_force(runs: list[np.ndarray], example: Example, metric: PerceptualMetric, count: int) -> list[Hit]:
    length = int(example.offsets[-1])
    poses = example.poses.rows
    left = [
        Hit(0, run, row, float(np.mean([pose_distance(q, rows[row + o], metric)
                                        for q, o in zip(poses, example.offsets, strict=True)])), False)
        for run, rows in enumerate(runs) for row in range(len(rows) - length)
    ]  # fmt: skip
    hits: list[Hit] = []
    for one in sorted(left, key=lambda hit: (hit.distance, hit.run, hit.row)):
        if len(hits) < count and all(
            hit.run != one.run or abs(hit.row - one.row) >= example.separation_rows for hit in hits
        ):
            hits.append(one)
    return hits


def random_run(rng: np.random.Generator, count: int, step: float) -> np.ndarray:
    rows = np.cumsum(rng.normal(0.0, step, (count, WIDTH)), axis=0) + rng.normal(0.0, 0.3, WIDTH)
    turns = rows[:, 90:].reshape(count, 11, 4)
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    turns *= rng.choice([-1.0, 1.0], (count, 11, 1))
    return rows.astype(np.float32)


@settings(deadline=None, max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.sampled_from([0.0, 1e-3, 0.02, 0.5]),
    seconds=st.sampled_from([0.0, 0.3, 1.0]),
    name=st.sampled_from(["sigmoid", "manhattan", "euclid", "positions-sigmoid", "angles-manhattan"]),
    count=st.integers(1, 12),
)
def test_a_search_finds_what_brute_force_finds(
    tmp_path_factory: pytest.TempPathFactory, seed: int, step: float, seconds: float, name: str, count: int
) -> None:
    rng = np.random.default_rng(seed)
    runs = [random_run(rng, int(rng.integers(1, 60)), step) for _ in range(4)]
    runs.append(runs[int(rng.integers(4))].copy())  # equal distances
    metric, offsets = metric_of(built_in_metric(f"published/{name}")), sample_offsets(seconds)
    source = random_run(rng, 40, step) if seed % 2 else np.concatenate([*runs, runs[0]])[-40:]
    example = Example(PoseFeatures(source[:1].repeat(len(offsets), 0) if step == 0 else source[offsets % len(source)],
                                   np.ones(15, np.bool_)), offsets)  # fmt: skip
    found = search_windows([searched(tmp_path_factory.mktemp("shards"), runs)], example, metric, count, threads=2)
    expected = by_brute_force(runs, example, metric, count)
    assert [hit[:3] for hit in found] == [hit[:3] for hit in expected]
    np.testing.assert_allclose([hit.distance for hit in found], [hit.distance for hit in expected], atol=1e-6)


def test_clips_with_a_window_within_a_distance_are_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    runs = [random_run(rng, int(rng.integers(1, 90)), 0.02) for _ in range(40)]
    metric, offsets = metric_of(built_in_metric("published/sigmoid")), sample_offsets(0.3)
    example = Example(PoseFeatures(runs[3][offsets], np.ones(15, np.bool_)), offsets)
    parts = [searched(tmp_path, runs[:25], name="a"), searched(tmp_path, runs[25:], name="b")]
    least: dict[tuple[int, int], float] = {}
    for hit in by_brute_force(runs, example, metric, 10_000):
        least.setdefault(divmod(hit.run, 25), hit.distance)
    assert least[0, 3] == 0.0
    for distance in (0.0, *np.quantile(list(least.values()), (0.2, 0.7)), 1e6):
        expected = sorted(run for run, apart in least.items() if apart <= distance)
        assert search_clips(parts, example, metric, distance + 1e-5, 100, threads=2) == expected
    assert search_clips(parts, example, metric, 0.0, 100, below=True) == []
    assert len(search_clips(parts, example, metric, 1e6, 5)) == 5


def exhaustively(
    parts: list[SearchedShard], example: Example, metric: PerceptualMetric, count: int
) -> list[tuple[int, int, int, float]]:
    """Find the hits by the kernel of distances alone, without bounds, steps or limits."""
    tables, order, length = metric_tables(metric, example.poses.present), example.order, int(example.offsets[-1])
    assert tables is not None
    found = []
    for number, part in enumerate(parts):
        shard = part.load()
        for run in range(len(part.ranks)):
            rows = shard.rows[shard.runs.starts[run] : shard.runs.starts[run + 1]]
            for row in range(len(rows) - length):
                total = 0.0
                for t in order:
                    one, other = example.poses.rows[t], rows[row + example.offsets[t]]
                    total += pose_distance_kernel(one, other, tables, ROTATIONS_AT)
                found.append((total / len(order), int(part.ranks[run]), row, number, run))
    hits: list[tuple[int, int, int, float]] = []
    for distance, _, row, number, run in sorted(found):
        overlaps = any(hit[:2] == (number, run) and abs(hit[2] - row) < example.separation_rows for hit in hits)
        if len(hits) < count and not overlaps:
            hits.append((number, run, row, distance))
    return hits


def random_metric(rng: np.random.Generator, name: str) -> PerceptualMetric:
    """Return a built-in metric with random weights (some are 0), random constants, and a random measure of angles."""
    metric = metric_of(built_in_metric(name))
    parts = []
    for part in metric.components:
        weights = {joint: float(rng.gamma(0.5)) * bool(rng.integers(4)) for joint in part.weights}
        weights[str(rng.choice(list(weights)))] = 1.0
        parts.append(replace(part, weights=weights, constant=float(rng.choice([0.0, 0.3]))))
    angle = rng.choice(["half_angle", "angle", "one_minus_dot"])
    return replace(metric, components=tuple(parts), angle=cast(AngleMeasure, str(angle)))


UGLY: dict[str, Callable[[np.random.Generator], list[np.ndarray]]] = {
    "constant": lambda rng: [np.repeat(random_run(rng, 1, 0.1), int(n), 0) for n in rng.integers(1, 70, 4)],
    "duplicates": lambda rng: [random_run(np.random.default_rng(7), 50, 0.02) for _ in range(5)],
    "short": lambda rng: [random_run(rng, int(n), 0.05) for n in rng.integers(1, 8, 40)],
    "one clip": lambda rng: [random_run(rng, 200, 0.02)],
    "huge": lambda rng: [
        random_run(rng, 60, 0.05) * np.repeat(np.array([1e6, 1], np.float32), [90, 44]) for _ in range(3)
    ],
}


@pytest.mark.parametrize("material", UGLY)
@pytest.mark.parametrize("seconds", [0.0, 0.5, 3.3])
def test_hits_and_distances_are_exactly_those_of_an_exhaustive_search(
    tmp_path: Path, material: str, seconds: float
) -> None:
    rng = np.random.default_rng([len(material), int(10 * seconds)])
    runs, offsets = UGLY[material](rng), sample_offsets(seconds)
    half = len(runs) // 2
    parts = [searched(tmp_path, some, name=str(n)) for n, some in enumerate((runs[:half], runs[half:])) if some]
    firsts = np.cumsum([0, *(len(part.ranks) for part in parts)])
    ranks = rng.permutation(len(runs))
    parts = [replace(part, ranks=ranks[firsts[n] : firsts[n + 1]]) for n, part in enumerate(parts)]
    names = ("published/sigmoid", "uniform/euclid", "published/angles-manhattan", "uniform/velocities-sigmoid")
    for name in rng.choice(names, 2, replace=False):
        metric = random_metric(rng, str(name))
        source = np.concatenate([runs[-1], random_run(rng, 130, 0.05)])
        example = Example(PoseFeatures(source[offsets], np.ones(15, np.bool_)), offsets)
        expected = exhaustively(parts, example, metric, 10)
        for count in (1, 10):
            found = search_windows(parts, example, metric, count, threads=2)
            assert [hit[:4] for hit in found] == expected[:count]


def test_dropped_overlaps_raise_the_limit_until_the_hits_are_those_of_an_exhaustive_search(tmp_path: Path) -> None:
    """The windows with the lowest bounds all overlap each other, so the first limits are wrong or missing."""
    rng = np.random.default_rng(3)
    pose = random_run(rng, 1, 0.1)
    near = np.repeat(pose, 700, 0) + rng.normal(0.0, 1e-4, (700, WIDTH)).astype(np.float32)
    runs = [near, *(random_run(rng, 40, 0.02) for _ in range(12))]
    offsets = sample_offsets(30.0)[:9]
    example = Example(PoseFeatures(np.repeat(pose, len(offsets), 0), np.ones(15, np.bool_)), offsets)
    short = Example(PoseFeatures(pose, np.ones(15, np.bool_)), sample_offsets(0.0))
    for one, count in ((example, 3), (short, 60)):
        parts = [searched(tmp_path, runs, name=str(count))]
        found = search_windows(parts, one, published_metric(), count)
        assert [hit[:4] for hit in found] == exhaustively(parts, one, published_metric(), count)
        assert len(found) > 1


def test_the_distance_is_the_perceptual_metric_of_the_clips(tmp_path: Path) -> None:
    slow, fast = (generate_gait(speed, 0.1, 3.0, frame_rate_hz=30.0) for speed in (1.1, 1.5))
    rows, offsets = features_of(fast).rows, sample_offsets(0.5)
    example = Example(PoseFeatures(features_of(slow).rows[30 + offsets], features_of(slow).present), offsets)
    body = MatchingBody.from_mapping(slow.skeleton, map_joints(slow.skeleton))
    one, other = (measure_motion(Motion.of(clip), body, 30.0) for clip in (slow, fast))
    metric = published_metric()
    (hit,) = search_windows([searched(tmp_path, [rows])], example, metric, 1)
    at_one, at_other = ((row + offsets).astype(np.float64) for row in (30, hit.row))
    exact = paired_distances(one.at(at_one), other.at(at_other), metric)
    assert hit.distance == pytest.approx(float(exact.mean()), abs=2e-5)


def test_searches_of_real_clips_find_all_of_the_ten_nearest(tmp_path: Path, mocap: Path) -> None:
    moves = ("bow_normal", "run_normal", "walk_normal", "walk_tired")
    files = [mocap / "bandai-namco-1" / f"dataset-1_{move}_001.bvh" for move in moves]
    clips = [read_motion(file.read_bytes(), file.name).clip for file in files]
    features = [features_of(clip) for clip in clips if clip is not None]
    runs = [each.rows[:60] for each in features]
    shard, offsets = searched(tmp_path, runs), sample_offsets(0.1)
    last = len(runs[2]) - 1 - int(offsets[-1])
    for start, shaping in ((0, "sigmoid"), (last, "euclid")):  # windows at both ends of a walk
        example = Example(PoseFeatures(runs[2][start + offsets], features[2].present), offsets)
        metric = published_metric(shaping)
        found = search_windows([shard], example, metric, 10)
        expected = by_brute_force(runs, example, metric, 10)
        assert found[0][1:4] == (2, start, 0.0)
        assert [hit[:3] for hit in found] == [hit[:3] for hit in expected]
        np.testing.assert_allclose([hit.distance for hit in found], [hit.distance for hit in expected], atol=1e-6)


def test_shards_and_their_number_make_no_difference(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    runs = [random_run(rng, 90, 0.02) for _ in range(6)]
    example = Example(PoseFeatures(runs[2][sample_offsets(0.5) + 9], np.ones(15, np.bool_)), sample_offsets(0.5))
    (whole,) = [searched(tmp_path, runs)]
    parts = [searched(tmp_path, runs[first : first + 2], name=str(first)) for first in (0, 2, 4)]
    parts = [SearchedShard(one.load, one.ranks + 2 * number, one.closed) for number, one in enumerate(parts)]
    metric = published_metric()
    one = [(hit.run, *hit[2:]) for hit in search_windows([whole], example, metric, 20)]
    other = [(hit.run + 2 * hit.shard, *hit[2:]) for hit in search_windows(parts, example, metric, 20)]
    assert one == other
    closed = SearchedShard(whole.load, whole.ranks, np.arange(6) == 2)
    assert all(hit.run != 2 for hit in search_windows([closed], example, metric, 20))


def test_a_mirrored_example_finds_the_mirrored_clip(tmp_path: Path) -> None:
    clip = generate_gait(1.5, 0.5, 3.0)
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    features, other = features_of(clip), features_of(mirror_clip(clip, body.partners))
    np.testing.assert_allclose(mirrored(features).rows[:, :90], other.rows[:, :90], atol=1e-4)
    example = Example(PoseFeatures(features.rows[30 + sample_offsets(0.5)], features.present), sample_offsets(0.5))
    (hit,) = search_windows([searched(tmp_path, [other.rows])], example, published_metric(), 1, mirror=True)
    assert (hit.row, hit.mirrored) == (30, True)
    assert hit.distance < 0.3


def test_a_motion_is_found_on_another_skeleton_and_at_another_rate(tmp_path: Path) -> None:
    clips = [generate_gait(speed, 0.0, 3.0, frame_rate_hz=120.0) for speed in (0.8, 1.2, 1.5, 2.0)]
    skeletons = clips[0].skeleton, game_skeleton()
    rigs = [(one, map_joints(one), guess_axes(one, map_joints(one))) for one in skeletons]
    moved = [features_of(retarget(clip, plan_retarget(*rigs[0], *rigs[1]))) for clip in clips]
    features, offsets = features_of(clips[2]), sample_offsets(1.0)
    example = Example(PoseFeatures(features.rows[30 + offsets], features.present), offsets)
    shard = searched(tmp_path, [one.rows for one in moved], present=[presence(one) for one in moved])
    (hit,) = search_windows([shard], example, published_metric(), 1)
    assert (hit.run, abs(hit.row - 30) <= 1) == (2, True)


def test_missing_joints_and_unusable_metrics_are_told(tmp_path: Path) -> None:
    rows = random_run(np.random.default_rng(1), 60, 0.02)
    shard = searched(tmp_path, [rows, rows], present=[ALL, 1])  # the second clip has a head alone
    example = Example(PoseFeatures(rows[:1], np.ones(15, np.bool_)), sample_offsets(0.0))
    assert {hit.run for hit in search_windows([shard], example, published_metric(), 10)} == {0}
    assert search_windows([], example, published_metric(), 10) == []
    headless = Example(PoseFeatures(rows[:1], np.zeros(15, np.bool_)), sample_offsets(0.0))
    with pytest.raises(MotionError, match="lacks joints that the metric compares"):
        search_windows([shard], headless, published_metric(), 1)
    metric = published_metric()
    turned = PerceptualMetric("t", metric.components, metric.shares, root_alignment="kovar2d")
    with pytest.raises(MotionError, match="superposes"):
        search_windows([shard], example, turned, 1)
    (tmp_path / "cut").write_bytes((tmp_path / "s").read_bytes()[:-4])
    with pytest.raises(MotionError, match="is no shard"):
        Shard.open(tmp_path / "cut", Runs.of(np.array([60, 60])), np.array([ALL, ALL]))


def test_samples_of_a_window_are_whole_steps_apart() -> None:
    for seconds in (0.0, 0.05, 0.1, 1.0, 3.1, 3.3, 60.0):
        offsets = sample_offsets(seconds)
        assert offsets[0] == 0
        assert len(offsets) <= 32
        assert set(np.diff(offsets) % 3) <= {0}
        assert offsets[-1] <= seconds * INDEX_RATE_HZ + 1e-6
