"""One evaluation in a separate process: `python -m benchmarks.evaluation_run ROWS THREADS` prints the measurements."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from benchmarks.material import real_folder
from marey_motion.clip import Clip
from marey_motion.evaluation.replicates import run_replicates
from marey_motion.evaluation.suite import assemble, run_suite
from marey_motion.formats import read_motion
from marey_motion.gait import generate_dataset
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.rigs import map_joints
from marey_schemas.options.evaluation import EvaluationOptions

ONE_SKELETON = ("bandai-namco-1/*.bvh", "bandai-namco-2/*.bvh")
LEAST_ROWS = 30
PACE = 0.1
"""Greatest relative change of speed, up or down, of a take that is used again."""


def main(row_count: int, threads: int) -> dict[str, float | str]:
    """Return how many seconds the database and the evaluation take, and the peak memory of the process in MiB."""
    sources = list(_sources(row_count))
    options = EvaluationOptions()
    # Kernels load and the machine's caches warm up on something small.
    _evaluate(_database(sources[:3]), options.replace(duration_s=2.0), threads)
    started = time.perf_counter()
    database = _database(sources)
    built = time.perf_counter()
    ran = _evaluate(database, options, threads)
    ended = time.perf_counter()
    return {
        "rows": database.row_count,
        "clips": len(sources),
        "material": "real takes" if real_folder() else "generated takes",
        "trials": len(ran),
        "replicates": options.replicates,
        "simulated_s": options.replicates * len(ran) * (options.approach_s + options.duration_s),
        "build_s": built - started,
        "evaluate_s": ended - built,
        "peak_mb": _peak_mb(),
    }


def _peak_mb() -> float:
    """Return the peak memory of this program in MiB; `getrusage` would include the memory of its parent process."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def _database(sources: list[SourceClip]) -> MatchingDatabase:
    skeleton = sources[0].clip.skeleton
    return build_database(sources, MatchingBody.from_mapping(skeleton, map_joints(skeleton)))


def _evaluate(database: MatchingDatabase, options: EvaluationOptions, threads: int) -> tuple[object, ...]:
    from marey_motion.evaluation.scenario import suite_trials

    trials = suite_trials(options)
    records = run_suite(database, options, threads=threads)
    replicates = run_replicates(database, options, trials, threads=threads)
    return assemble(database, options, trials, records, replicates=replicates).trials


def _sources(row_count: int) -> Iterator[SourceClip]:
    """Yield clips of one skeleton with `row_count` rows in total: all takes, then the same takes at other speeds."""
    rng = np.random.default_rng(row_count)
    takes = _takes()
    left = row_count
    for number in count():
        name, clip = takes[number % len(takes)]
        if number >= len(takes):
            clip = replace(clip, frame_rate_hz=clip.frame_rate_hz * rng.uniform(1.0 - PACE, 1.0 + PACE))
        frames = min(clip.frame_count, int(left / 60.0 * clip.frame_rate_hz) + 1)
        rows = int((frames - 1) / clip.frame_rate_hz * 60.0 + 1e-6) + 1
        yield SourceClip(f"{number:05}", f"{name} {number // len(takes)}", clip.sliced(0, frames))
        left -= rows
        if left < LEAST_ROWS:
            return


def _takes() -> list[tuple[str, Clip]]:
    folder = real_folder()
    if folder is None:
        return [(take.name, take.clip) for take in generate_dataset()]
    takes = []
    for path in sorted(file for pattern in ONE_SKELETON for file in folder.glob(pattern)):
        clip = read_motion(path.read_bytes(), path.name).clip
        assert clip is not None, f"{path.name} holds no motion"
        takes.append((path.stem, clip))
    return takes


if __name__ == "__main__":
    json.dump(main(int(sys.argv[1]), int(sys.argv[2])), sys.stdout)
