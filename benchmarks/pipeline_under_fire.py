"""Check that a pipeline whose workers are killed at random moments gives the same bytes as an undisturbed one.

`python -m benchmarks.pipeline_under_fire [TAKES [KILLS [SEED]]]` makes a model of 200 generated takes three times: with
one worker, with two workers, and with one worker that is killed ten times. It prints the duration of each run.
"""

from __future__ import annotations

import math
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from benchmarks.local_server import LocalServer, clean_environment, running
from marey_client import Marey
from marey_client.handles.pipelines import PipelineRun
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_client.submitting.requests import plan_model
from marey_motion.clip import Clip
from marey_motion.formats import write_motion
from marey_motion.gait import game_skeleton, generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.encoding.canonical import array_digest
from marey_schemas.kinds import Kind
from marey_schemas.queue.model_pipelines import model_pipeline

TAKES, KILLS, SEED = 200, 10, 7
SECONDS, RATE_HZ = 1.2, 60.0
PATIENCE_S = 1800.0
LONGEST_PAUSE_S = 2.0
QUICK_LEASES = {"MAREY_LEASE_TTL_S": "3", "MAREY_HEARTBEAT_S": "0.5", "MAREY_CANCEL_GRACE_S": "2"}
PARTS = {Kind.PROCESSED: ("motion", "info"), Kind.MODEL: ("model", "tree")}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a pipeline: its duration, the times at which workers were killed, and digests of its arrays."""

    seconds: float
    attempts: int
    lost: int
    digests: Mapping[str, str]
    moments: Sequence[str]


def write_takes(folder: Path, count: int, seconds: float = SECONDS) -> Path:
    """Write walks of different speeds and turns as BVH files; return their folder.

    The file `game.bvh` beside this folder contains a skeleton to which the walks can be retargeted.
    """
    takes = folder / "takes"
    takes.mkdir(parents=True)
    chance = random.Random(count)
    for number in range(count):
        clip = generate_gait(0.9 + 0.8 * number / count, chance.gauss(0.0, 0.2), seconds, RATE_HZ)
        (takes / f"walk-{number:03d}.bvh").write_bytes(write_motion(clip, "bvh"))
    skeleton = game_skeleton()
    at_rest = np.concatenate([skeleton.offsets[0], skeleton.rest_rotations.ravel()]).astype(np.float32)
    rig = Clip(skeleton, RATE_HZ, np.tile(at_rest, (5, 1)), None, ())
    (folder / "game.bvh").write_bytes(write_motion(rig, "bvh"))
    return takes


def run_pipeline(
    material: Path,
    data: Path,
    *,
    workers: int = 1,
    kills: int = 0,
    chance: random.Random | None = None,
    settings: Mapping[str, str] = MappingProxyType({}),
    **choices: Any,
) -> Outcome:
    """Make a model of the takes in a folder, on a new server; `choices` are arguments of `plan_model`.

    All workers are killed and started again `kills` times, each time a moment after a worker has begun a step; the
    kills are distributed over the steps.
    """
    data.parent.mkdir(parents=True, exist_ok=True)
    with running(data, **QUICK_LEASES, **settings) as server, server.client() as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        wanted = _plan(lab, material, choices)
        started = time.monotonic()
        with at_work(server, workers) as shift:
            run = lab.pipeline(wanted)
            fire = _Fire(marey, run, shift, chance or random.Random(), math.ceil(kills / len(wanted.steps)))
            moments = [fire.shoot() for _ in range(kills)]
            run.wait(timeout_s=PATIENCE_S)
        tries = list(_attempts(marey, lab))
        return Outcome(time.monotonic() - started, len(tries), tries.count("lost"), digests(lab), moments)


def _plan(lab: ProjectHandle, material: Path, choices: Mapping[str, Any]) -> Any:
    [rig] = lab.imports.upload(find_files([material / "game.bvh"]).files)
    files = find_files([material / "takes"]).files
    plan = plan_model(lab, files, name="walk", skeleton={"item": rig.skeleton}, **choices)
    # A job may be unlucky more often than three times when ten kills fall on it.
    return model_pipeline(plan, seed=SEED, max_attempts=20)


def _attempts(marey: Marey, lab: ProjectHandle) -> Iterator[str | None]:
    for job in list(lab.jobs()):
        for one in (job, *marey.jobs.list(lab.name, filters={"parent": job.id})):
            yield from (attempt.outcome for attempt in marey.jobs.attempts(one.id))


def digests(lab: ProjectHandle) -> dict[str, str]:
    """Return the digest of each array of aligned clips and models.

    The keys contain the path of the item and the place of the array in the item's documents.
    """
    found: dict[str, str] = {}
    for kind, parts in PARTS.items():
        for one in lab.items(kind).list():
            for part in parts:
                for path, array in _arrays(one.part(part)):
                    found[f"{one.path}/{part}{path}"] = array_digest(array)
    return found


def _arrays(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, np.ndarray):
        yield path, tree
    elif isinstance(tree, Mapping):
        for name, value in tree.items():
            yield from _arrays(value, f"{path}/{name}")
    elif isinstance(tree, (list, tuple)):
        for index, value in enumerate(tree):
            yield from _arrays(value, f"{path}/{index}")


# -- workers ----------------------------------------------------------------------------------------------------------


class Shift:
    """Workers of a server, which can be killed together and started again."""

    def __init__(self, server: LocalServer, count: int) -> None:
        self._server = server
        self._count = count
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start every worker."""
        self._processes = [self._worker(number) for number in range(self._count)]

    def kill(self) -> None:
        """Kill all workers at once, as a power failure would."""
        for process in self._processes:
            process.kill()
            process.wait()

    def _worker(self, number: int) -> subprocess.Popen[bytes]:
        folder = self._server.data.parent
        arguments = ["--attached", "--server", self._server.url, "--name", f"w{number}"]
        arguments += ["--cache", str(folder / f"cache-{number}")]
        with (folder / "workers.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "marey_worker", *arguments],
                env=clean_environment(), stdin=subprocess.PIPE, stdout=log, stderr=log,
            )  # fmt: skip
        assert process.stdin is not None
        process.stdin.write(f"{self._server.token}\n".encode())
        process.stdin.flush()
        return process


@contextmanager
def at_work(server: LocalServer, count: int) -> Iterator[Shift]:
    """Keep `count` workers running while the `with` block runs."""
    shift = Shift(server, count)
    with ExitStack() as stack:
        stack.callback(shift.kill)
        shift.start()
        yield shift


class _Fire:
    """Kills the workers that run a pipeline."""

    def __init__(self, marey: Marey, run: PipelineRun, shift: Shift, chance: random.Random, at_each_step: int) -> None:
        self._marey = marey
        self._run = run
        self._shift = shift
        self._chance = chance
        self._left = dict.fromkeys(run.refresh(), at_each_step)
        self._seen: set[tuple[str, int]] = set()

    def shoot(self) -> str:
        """Kill all workers a moment after one has begun a step, and start them again; return the pause and the step."""
        deadline = time.monotonic() + PATIENCE_S
        while not (begun := [step for step in self._begun() if self._left[step] > 0]):
            if self._run.ended or time.monotonic() > deadline:
                raise RuntimeError(f"no worker began a further step, so none was killed: {self._run}; use more takes")
            time.sleep(0.05)
        for step in begun:
            self._left[step] -= 1
        pause_s = self._chance.uniform(0.0, LONGEST_PAUSE_S)
        time.sleep(pause_s)
        self._shift.kill()
        self._shift.start()
        return f"{pause_s:.2f} s after {' and '.join(sorted(begun))} had begun"

    def _begun(self) -> list[str]:
        """Return the steps in which a worker has begun a job since the last call."""
        begun = []
        for name, job in self._run.refresh().items():
            if job.state != "running":
                continue
            tasks = self._marey.jobs.list(job.project, filters={"parent": job.id, "state": "running"})
            leases = {(one.id, one.fence) for one in ([job] if job.size is None else tasks)}
            if leases - self._seen:
                begun.append(name)
            self._seen |= leases
        return begun


# -- the comparison ---------------------------------------------------------------------------------------------------


def main(takes: int = TAKES, kills: int = KILLS, seed: int = SEED) -> None:
    """Run the pipeline three times, print its durations, and exit with an error if the results differ."""
    with tempfile.TemporaryDirectory(prefix="marey-fire-") as folder:
        material = Path(folder, "material")
        write_takes(material, takes)
        alone = run_pipeline(material, Path(folder, "one", "data"))
        _tell("one worker", alone)
        double = run_pipeline(material, Path(folder, "two", "data"), workers=2)
        _tell("two workers", double)
        fired = run_pipeline(material, Path(folder, "fire", "data"), kills=kills, chance=random.Random(seed))
        _tell(f"one worker, killed {kills} times", fired)
        for moment in fired.moments:
            print(f"    {moment}")
    differing = {what: _differing(alone, other) for what, other in (("two workers", double), ("killed", fired))}
    if any(differing.values()):
        sys.exit("\n".join(f"not the same, {what}: {', '.join(places)}" for what, places in differing.items()))
    print(f"all {len(alone.digests)} arrays are the same in every run")


def _differing(one: Outcome, other: Outcome) -> list[str]:
    """Return the places of arrays that differ between two outcomes, or that only one outcome has."""
    places = sorted(one.digests.keys() | other.digests.keys())
    return [place for place in places if one.digests.get(place) != other.digests.get(place)]


def _tell(what: str, outcome: Outcome) -> None:
    print(f"{what}: {outcome.seconds:.1f} s, {outcome.attempts} attempts, {outcome.lost} of them lost", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
