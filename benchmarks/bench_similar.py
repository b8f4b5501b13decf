"""Exact searches by example, compared with searches of all windows in numpy.

The number of poses can be given: `python -m benchmarks.bench_similar 3000000` measures 100,000 s of motion at 30 Hz,
for which 2 GB of temporary files are written.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.similar_material import takes, with_copies
from benchmarks.timing import Row
from marey_motion.arrays import Floats
from marey_motion.perception.metric import JOINT_CLASSES, PerceptualMetric, published_metric
from marey_motion.similarity.example import Example, sample_offsets
from marey_motion.similarity.features import JOINTS, ROTATED_JOINTS, ROTATIONS_AT, VECTORS, PoseFeatures, Rows
from marey_motion.similarity.searching import search_windows
from marey_motion.similarity.shard_search import SearchedShard
from marey_motion.similarity.shards import FULL_SHARD_ROWS, Runs, Shard, presence, write_shard

GOAL_MS, GOAL_POSES = 200, 3_000_000
POSES, SEARCHES, HITS, THREADS = 60_000, 30, 10, 2
_LENGTHS = (("one pose", 0.0), ("1 s", 1.0), ("3 s", 3.0))
_ALL = (1 << len(JOINTS)) - 1


def run(poses: int = POSES) -> list[Row]:
    """Measure the processor time of both threads together, for each of some examples; half of them are unchanged takes.

    For the first example of each length, the hits must equal the hits that numpy finds.
    """
    originals = [one for one in takes() if presence(one) == _ALL]
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        shards = list(_written(Path(folder), with_copies(originals, poses)))
        search_windows(shards[:1], _examples(shards, 0.5)[0], published_metric(), HITS, threads=THREADS)  # compile
        return [_row(name, poses, shards, _examples(shards, seconds)) for name, seconds in _LENGTHS]


def _written(folder: Path, features: Iterable[PoseFeatures]) -> Iterable[SearchedShard]:
    """Write each shard as soon as it is full."""
    runs: list[Rows] = []
    written = 0

    def shard() -> SearchedShard:
        path, lengths = folder / str(written), np.array([len(run) for run in runs])
        write_shard(path, runs)
        ranks = np.arange(len(runs)) + 100_000 * written
        joints = np.full(len(runs), _ALL)
        return SearchedShard(partial(Shard.open, path, Runs.of(lengths), joints), ranks, np.zeros(len(runs), np.bool_))

    for one in features:
        runs.append(one.rows)
        if sum(map(len, runs)) >= FULL_SHARD_ROWS:
            yield shard()
            runs, written = [], written + 1
    if runs:
        yield shard()


def _examples(shards: list[SearchedShard], seconds: float) -> list[Example]:
    """Choose windows alternately from the first takes, which are unchanged, and from any shard."""
    rng, offsets = np.random.default_rng(0), sample_offsets(seconds)
    examples: list[Example] = []
    while len(examples) < SEARCHES:
        shard = shards[0 if len(examples) % 2 == 0 else int(rng.integers(len(shards)))].load()
        run = int(rng.integers(len(shard.joints)))
        first, last = shard.runs.starts[run : run + 2]
        if last - first > offsets[-1]:
            start = first + int(rng.integers(last - first - offsets[-1]))
            examples.append(Example(PoseFeatures(shard.rows[start + offsets], np.ones(len(JOINTS), np.bool_)), offsets))
    return examples


def _row(name: str, poses: int, shards: list[SearchedShard], examples: list[Example]) -> Row:
    metric = published_metric()
    taken, found = [], []
    for example in examples:
        start = time.process_time()
        found.append(search_windows(shards, example, metric, HITS, threads=THREADS))
        taken.append(time.process_time() - start)
    start = time.process_time()
    expected = _by_numpy(shards, examples[0], metric)
    peer = time.process_time() - start
    np.testing.assert_allclose([hit.distance for hit in found[0]], expected, rtol=1e-5, atol=1e-5)
    median, most = np.median(taken) * 1e3, max(taken) * 1e3
    whole = poses >= GOAL_POSES
    return Row(
        f"search by example of {name}", f"{poses:,} poses", f"{median:.1f} ms, at most {most:.1f}",
        f"numpy, all windows {peer:.2f} s", peer * 1e3 / median, f"< {GOAL_MS} ms" if whole else "",
        bool(median < GOAL_MS) if whole else None,
    )  # fmt: skip


def _by_numpy(shards: list[SearchedShard], example: Example, metric: PerceptualMetric) -> list[float]:
    """Return the distances of the hits, from the distances of all windows."""
    found: list[tuple[float, int, int]] = []
    length = int(example.offsets[-1])
    for searched in shards:
        shard = searched.load()
        for first, last, rank in zip(shard.runs.starts, shard.runs.starts[1:], searched.ranks, strict=False):
            count = int(last - first) - length
            if count > 0:
                pairs = zip(example.poses.rows, example.offsets, strict=True)
                sums = np.zeros(count)
                for one, at in pairs:
                    sums += _distances(one, shard.rows[first + at : first + at + count], metric)
                found += [(each, int(rank), row) for row, each in enumerate(sums / len(example.offsets))]
    hits: list[tuple[float, int, int]] = []
    for one in sorted(found):
        if all(one[1] != hit[1] or abs(one[2] - hit[2]) >= example.separation_rows for hit in hits):
            hits.append(one)
        if len(hits) == HITS:
            break
    return [hit[0] for hit in hits]


def _distances(pose: Rows, rows: Rows, metric: PerceptualMetric) -> Floats:
    """Compute the distances of rows (n, WIDTH) from a pose, by the formulas of the metric."""
    a, b = pose.astype(np.float64), rows.astype(np.float64)
    apart = np.linalg.norm((b - a)[:, :ROTATIONS_AT].reshape(-1, VECTORS, 3), axis=2)
    turns, turn = b[:, ROTATIONS_AT:].reshape(-1, len(ROTATED_JOINTS), 4), a[ROTATIONS_AT:].reshape(-1, 4)
    chords = np.minimum(np.linalg.norm(turns - turn, axis=2), np.linalg.norm(turns + turn, axis=2))
    measured = {
        "angles": (ROTATED_JOINTS, 2.0 * np.arcsin(np.minimum(chords / 2.0, 1.0))),
        "positions": (JOINTS, apart[:, : len(JOINTS)] / metric.length_unit_m),
        "velocities": (JOINTS, apart[:, len(JOINTS) :] * metric.velocity_interval_s / metric.length_unit_m),
    }
    shaped = {"sigmoid": lambda x: x / (x + 1.0), "manhattan": lambda x: x, "euclid": lambda x: x * x}
    total = np.zeros(len(rows))
    for share, part in zip(metric.shares, metric.components, strict=True):
        joints, distances = measured[part.measurement]
        raw = np.zeros(len(rows))
        for name, weight in part.weights.items():
            places = [joints.index(joint) for joint in JOINT_CLASSES[name]]
            raw += weight / sum(part.weights.values()) * shaped[part.shaping](distances[:, places].mean(axis=1))
        total += share * (part.norm * raw + part.constant * (raw > 0.0))
    return total


if __name__ == "__main__":
    for row in run(int(sys.argv[1]) if len(sys.argv) > 1 else POSES):
        print(row)
