"""Jobs that retarget clips and write them to BVH files with one worker, compared with pymotion in one process.

The worker runs one job at a time, then two, each in its own process. Marey's times are as long as a person waits, from
the submission to the end of the job: the worker reads clips from the server, computes and sends the results, and the
server checks and publishes them. pymotion computes from arrays in memory.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymotion.io.bvh import BVH
from pymotion.ops import skeleton as pymotion_skeleton
from pymotion.rotations import quat as pymotion_quat

from benchmarks.local_server import PROJECT, clip_parts, local_server, one_worker
from benchmarks.material import captured_walk
from benchmarks.timing import Row
from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_motion.clip import Clip
from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.formats import write_bvh
from marey_motion.gait import game_skeleton
from marey_motion.retargeting import RetargetPlan, plan_retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.references import RevisionRef
from marey_schemas.queue.jobs import CollectionInput, Job, JobCreate

CLIPS, FRAMES, JOINTS = 328, 287, 31
WARMING_CLIPS = 64
"""Number of clips that are retargeted first, so that all processes of the worker have warmed up."""
GOAL_POSES_PER_S = 50_000

Floats = NDArray[np.floating]


def run() -> list[Row]:
    """Measure a worker that runs one job at a time, and one that runs two, each with a server of its own."""
    clips = [captured_walk(FRAMES, JOINTS, seed) for seed in range(CLIPS)]
    ours = {slots: _measure(clips, slots) for slots in (1, 2)}
    plan = _plan(clips[0].skeleton, game_skeleton())
    moved, peer_retargeting_s = _retarget_with_pymotion(clips, plan)
    peer_writing_s = _write_with_pymotion(moved, plan.target)
    return [
        row
        for slots, (retargeting_s, writing_s) in ours.items()
        for row in (
            _row("clips to retargeted clips", slots, retargeting_s, peer_retargeting_s, GOAL_POSES_PER_S),
            _row("clips to BVH files", slots, writing_s, peer_writing_s, None),
        )
    ]


def _measure(clips: list[Clip], slots: int) -> tuple[float, float]:
    """Return how many seconds one worker takes to retarget the clips, and to write the results to BVH files."""
    with local_server() as server, one_worker(server, slots=slots), server.client() as marey:
        project = marey.create_project(ProjectCreate(name=PROJECT))
        target = _seed(project, clips)
        marey.jobs.wait(project.retarget([CollectionInput(collection="first")], target, into="warm").id)
        takes, game = CollectionInput(collection="takes"), CollectionInput(collection="game")
        export = JobCreate(kind="export", inputs={"clips": (game,)}, params={"format": "bvh"})
        retargeting_s = _timed(marey, lambda: project.retarget([takes], target, into=game.collection))
        return retargeting_s, _timed(marey, lambda: project.submit(export))


def _seed(project: ProjectHandle, clips: list[Clip]) -> str:
    """Store `clips` in the folder `takes`, and a target skeleton; return the skeleton's id.

    Other clips, for a warm-up of the worker, are stored in the folder `first`.
    """
    skeletons = []
    for name, skeleton in (("studio", clips[0].skeleton), ("game", game_skeleton())):
        mapping = map_joints(skeleton)
        parts = {
            "hierarchy": skeleton_to_document(skeleton).model_dump(by_alias=True),
            "mapping": mapping_to_document(mapping, guess_axes(skeleton, mapping)).model_dump(by_alias=True),
        }
        skeletons.append(project.skeletons.create(name, parts).item.id)
    studio = RevisionRef(item=skeletons[0], revision=1)
    for number, clip in enumerate(clips):
        project.clips.create(f"take-{number:03}", clip_parts(clip, studio), collection="takes")
    for number in range(WARMING_CLIPS):
        warming = captured_walk(FRAMES, JOINTS, CLIPS + number)
        project.clips.create(f"warm-up-{number:02}", clip_parts(warming, studio), collection="first")
    return skeletons[1]


def _timed(marey: Marey, submit: Callable[[], Job]) -> float:
    """Submit a job and wait for its end; return how many seconds this takes."""
    started = time.perf_counter()
    ended = marey.jobs.wait(submit().id)
    seconds = time.perf_counter() - started
    assert ended.result is not None
    assert ended.result["clips"] == CLIPS, ended.result
    return seconds


def _plan(source: Skeleton, target: Skeleton) -> RetargetPlan:
    rigs = [(skeleton, mapping := map_joints(skeleton), guess_axes(skeleton, mapping)) for skeleton in (source, target)]
    return plan_retarget(*rigs[0], *rigs[1])


def _retarget_with_pymotion(clips: list[Clip], plan: RetargetPlan) -> tuple[list[Floats], float]:
    """Return the local rotations of the target's joints for each clip, and the total time in seconds."""
    offsets, parents = clips[0].skeleton.offsets.astype(np.float32), clips[0].skeleton.parents.copy()
    target_parents = plan.target.parents.copy()
    parents[0] = target_parents[0] = 0  # pymotion's mark of the root
    started = time.perf_counter()
    moved = []
    for clip in clips:
        _, turned = pymotion_skeleton.fk_quat(clip.rotations, clip.root_translations, offsets, parents)
        world = np.empty((clip.frame_count, plan.target.joint_count, 4))
        for joint, source in enumerate(plan.sources):
            if source >= 0:
                world[:, joint] = pymotion_quat.mul(turned[:, source], plan.corrections[joint])
            elif joint:
                world[:, joint] = pymotion_quat.mul(world[:, target_parents[joint]], plan.target.rest_rotations[joint])
            else:
                world[:, joint] = plan.target.rest_rotations[joint]
        moved.append(pymotion_skeleton.from_global_rotations(world, target_parents))
    return moved, time.perf_counter() - started


def _write_with_pymotion(moved: list[Floats], target: Skeleton) -> float:
    """Return how many seconds pymotion takes to write clips as BVH files."""
    rest = np.tile(np.concatenate([target.offsets[0], target.rest_rotations.ravel()]), (FRAMES, 1)).astype(np.float32)
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        template = Path(folder, "template.bvh")
        template.write_bytes(write_bvh(Clip(target, 60.0, rest)))
        file = BVH()
        file.load(str(template))
        _, positions, *_ = file.get_data()
        started = time.perf_counter()
        for number, rotations in enumerate(moved):
            file.set_data(rotations, positions)
            file.save(str(Path(folder, f"{number}.bvh")))
        return time.perf_counter() - started


def _row(job: str, slots: int, ours_s: float, peer_s: float, goal: int | None) -> Row:
    poses = CLIPS * FRAMES
    return Row(
        job,
        f"{CLIPS} clips of {FRAMES} frames, one worker with {slots} {'slot' if slots == 1 else 'slots'}",
        f"{poses / ours_s:,.0f} poses/s",
        f"pymotion in one process, from memory: {poses / peer_s:,.0f} poses/s",
        peer_s / ours_s,
        "" if goal is None else f"≥ {goal:,} poses/s",
        None if goal is None else poses / ours_s >= goal,
    )
