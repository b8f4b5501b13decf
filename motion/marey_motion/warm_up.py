"""Compilation of all kernels in advance, so that first uses need not wait: `python -m marey_motion.warm_up`.

The compiled code is kept on disk; later processes load it in a fraction of a second.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip

PACKAGE = Path(__file__).parent
# Either numba itself or the options of a decorator that kernels share, at the outer level of the module.
_IMPORTS_COMPILER = re.compile(r"^(?:import numba|from (?:numba[\w.]*|[\w.]*kernels) import)\b", re.MULTILINE)
STAMP = Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE / "__pycache__") / "kernels-compiled"
"""File that records the origin of the compiled code, and whether the code is complete."""
_COMPILING, _DONE = "compiling", "done"

_ASF = b""":version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name femur
    direction 0 -1 0
    length 7
    axis 0 0 0 XYZ
    dof rx
  end
:hierarchy
  begin
    root femur
  end
"""
_AMC = b":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 16 0 0 0 0\nfemur 10\n2\nroot 0 16 0 0 0 0\nfemur 11.5\n"


def kernel_sources() -> list[Path]:
    """List the modules of the package that contain compiled functions: all modules that import the compiler.

    Returns
    -------
    list of Path    source files
    """
    return [source for source in PACKAGE.rglob("*.py") if _IMPORTS_COMPILER.search(source.read_text("utf-8"))]


def discard_outdated_kernels() -> None:
    """Remove all compiled code if the installed sources or the installed compiler have changed since the compilation.

    Then `STAMP` records that the compilation is not complete. Nothing is done if the folder of `STAMP` is not writable.

    The compiler's cache detects only changes in the file that defines a kernel. A compiled kernel also contains copies
    of the kernels that it calls and the names of the types of its arguments, which other files may define. Modification
    times cannot be used: files of an installed package have the times of the archive, which are the same for every
    version.
    """
    if _origin() == _recorded_origin() or not os.access(STAMP.parent, os.W_OK):
        return
    names = {source.stem for source in kernel_sources()}
    for compiled in (STAMP.parent if "NUMBA_CACHE_DIR" in os.environ else PACKAGE).rglob("*.nb[ic]"):
        if compiled.name.partition(".")[0] in names:
            compiled.unlink(missing_ok=True)
    _record(_COMPILING)


def _origin() -> str:
    """Compute the digest of the compiler's version and of every source of kernels."""
    digest = hashlib.sha256(version("numba").encode())
    for source in sorted(kernel_sources()):
        digest.update(b"\0" + source.relative_to(PACKAGE).as_posix().encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()


def _recorded_origin() -> str:
    """Return the digest of compiler and sources that is stored with the compiled code; empty if no digest is stored."""
    return STAMP.read_text("utf-8").partition(" ")[0] if STAMP.is_file() else ""


def kernels_are_compiled() -> bool:
    """Check whether everything is compiled, from the installed sources and by the installed compiler.

    Returns
    -------
    bool    True if no kernel is left to compile
    """
    return STAMP.is_file() and STAMP.read_text("utf-8") == f"{_origin()} {_DONE}"


def _record(state: str) -> None:
    """Write the digest of the sources and the state of the compilation to `STAMP`, if its folder is writable."""
    if os.access(STAMP.parent, os.W_OK):
        STAMP.write_text(f"{_origin()} {state}", "utf-8")


def compile_kernels(stages: Sequence[str], processes: int = 1) -> None:
    """Run the first of the given stages (names in `STAGES`), then run the other stages in parallel.

    Parameters
    ----------
    stages : sequence of str    names of stages
    processes : int    number of processes
    """
    first, *others = stages
    _compile(first)
    if processes < 2 or len(others) < 2:
        for stage in others:
            _compile(stage)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        list(pool.map(_compile, others))


def _compile(stage: str) -> None:
    from marey_motion.gait import generate_gait

    STAGES[stage](generate_gait(1.3, 0.2, 1.0))


def _read(clip: Clip) -> None:
    """Compile the kernels of files and retargeting: read, check and write a walk, and retarget it with translations."""
    from marey_motion.formats import ImportOptions, read_motion, write_motion
    from marey_motion.gait import game_skeleton
    from marey_motion.retargeting import plan_retarget, retarget
    from marey_motion.rigs import guess_axes, map_joints

    read_motion(_AMC, "walk.amc", companion=_ASF, options=ImportOptions(unit_scale_m=0.05644, up_axis="y"))
    read = read_motion(write_motion(clip, "bvh"), "walk.bvh").clip
    assert read is not None
    target = game_skeleton()
    rigs = []
    for skeleton in (read.skeleton, target):
        mapping = map_joints(skeleton)
        rigs.append((skeleton, mapping, guess_axes(skeleton, mapping)))
    plan = plan_retarget(*rigs[0], *rigs[1])
    knee = read.skeleton.index_of(rigs[0][1].joints["left_knee"])
    translations = np.full((read.frame_count, 1, 3), 0.1, np.float32)
    retarget(replace(read, translations=translations, translated_joints=(knee,)), plan)


def _edit(clip: Clip) -> None:
    """Compile the kernels of editing: constrain a wrist by every solver, and plant the feet."""
    from marey_motion.editing.registry import edit_clip
    from marey_schemas.editing.constraints import Constrain, PlantFeet, PositionConstraint, Solver

    wrist = PositionConstraint(joint="left_wrist", frames=(10, 12), shift_m=(0.0, 0.05, 0.0))
    constraining = [Constrain(constraints=(wrist,), solver=solver) for solver in get_args(Solver)]
    edit_clip(clip, [*constraining, PlantFeet()])


def _match(clip: Clip) -> None:
    """Compile the kernels of matching: build a database, search it, and simulate, display and explain a trial."""
    from marey_motion.evaluation.scenario import Trial, reference
    from marey_motion.matching.body import MatchingBody
    from marey_motion.matching.building import build_database
    from marey_motion.matching.controller import run_trial
    from marey_motion.matching.database import SourceClip
    from marey_motion.matching.display import displayed_clip
    from marey_motion.matching.explain import explain_choice
    from marey_motion.matching.search import build_index, find_best
    from marey_motion.rigs import map_joints
    from marey_schemas.options.matching import ControllerOptions

    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    database = build_database([SourceClip("walk", "walk", clip)], body)
    normalised = database.normaliser.apply(database.features)
    index = build_index(normalised, database.starts, database.selectable)
    find_best(index, normalised[0], 1)
    path, options = reference(Trial("circle", 1.3, 0.2, approach_s=0.5, duration_s=0.5)), ControllerOptions()
    record = run_trial(database, index, path, options)
    displayed_clip(database, record, options)
    explain_choice(database, index, path, options, record, 6)
    _compare(database.pose_points)


def _compare(points: NDArray[np.float32]) -> None:
    """Compile the kernels that compare poses: align a motion with itself by every method, and find nearest poses."""
    from marey_motion.alignment.dtw import RangeBounds, align, distances, warped_distance
    from marey_motion.evaluation.similarity import nearest_poses

    groups = np.arange(len(points))
    align(distances(points, points))
    align(distances(points, points), max_run=2)
    warped_distance(points, points)
    RangeBounds(points, np.array([0]), np.array([len(points)])).between(0, np.array([0]))
    nearest_poses(points, groups, points, groups)


def _align(clip: Clip) -> None:
    """Compile the kernels of alignment: align a clip with itself by every cost, with and without a slope limit."""
    from marey_motion.alignment.aligning import SourceExample, align_clips
    from marey_motion.matching.body import MatchingBody
    from marey_motion.rigs import map_joints
    from marey_schemas.options.alignment import AlignOptions

    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    examples = [SourceExample(uid, uid, clip) for uid in ("one", "other")]
    for options in (
        AlignOptions(cost="turned"),
        AlignOptions(cost="plain"),
        AlignOptions(cost="turned", window=3),
        AlignOptions(cost="plain", window=3),
    ):
        for slope_limit in (None, 3):
            align_clips(examples, body, options.replace(slope_limit=slope_limit))


def _perceive(clip: Clip) -> None:
    """Compile the kernels of motion maps and registration: compare a clip with itself, and as a cycle."""
    from marey_motion.matching.body import MatchingBody
    from marey_motion.motion import Motion
    from marey_motion.perception.maps import motion_map
    from marey_motion.perception.measuring import measure_motion
    from marey_motion.perception.metric import published_metric
    from marey_motion.perception.registration import registration_curve
    from marey_motion.rigs import map_joints

    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    measured = measure_motion(Motion.of(clip), body, clip.frame_rate_hz)
    motion_map(measured, measured, published_metric())
    cycle = replace(measured.at(np.arange(20.0)), cyclic=True)
    registration_curve(cycle, cycle, published_metric())


def _find_similar(clip: Clip) -> None:
    """Compile the kernels of searches by example: search a shard file for a window of a clip."""
    from marey_motion.matching.body import MatchingBody
    from marey_motion.motion import Motion
    from marey_motion.perception.metric import published_metric
    from marey_motion.rigs import map_joints
    from marey_motion.similarity.example import Example, sample_offsets
    from marey_motion.similarity.features import PoseFeatures, clip_features
    from marey_motion.similarity.searching import search_windows
    from marey_motion.similarity.shard_search import SearchedShard
    from marey_motion.similarity.shards import Runs, Shard, presence, write_shard

    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    features = clip_features(Motion.of(clip), body, clip.frame_rate_hz)
    offsets = sample_offsets(0.5)
    example = Example(PoseFeatures(features.rows[offsets], features.present), offsets)
    with TemporaryDirectory() as folder:
        path, lengths, joints = Path(folder, "shard"), np.array([len(features.rows)]), np.array([presence(features)])
        write_shard(path, [features.rows])
        searched = SearchedShard(
            lambda: Shard.open(path, Runs.of(lengths), joints), np.zeros(1, np.int64), np.zeros(1, bool)
        )
        search_windows([searched], example, published_metric(), 1)


def _measure(clip: Clip) -> None:
    """Compile the kernels of live recordings: measure the coverage of a clip by the code that receives live frames."""
    from marey_motion.evaluation.online import OnlineCoverage
    from marey_motion.matching.body import MatchingBody
    from marey_motion.rigs import map_joints

    online = OnlineCoverage(clip.frame_rate_hz)
    online.add_frames(MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton)), clip)
    online.end_take()


def _model(clip: Clip) -> None:
    """Compile the kernels of models: compute components of two motions, and the errors of their reconstruction."""
    from marey_motion.modelling.fpca import Keep, find_components
    from marey_motion.modelling.reconstruction import reconstruction_errors
    from marey_motion.modelling.scaled_fpca import optimised_weights
    from marey_motion.modelling.splines import SplineBasis
    from marey_motion.motion import Motion

    poses = np.stack([Motion.of(clip).poses, Motion.of(clip).poses])
    poses[1, :, :3] *= 1.1
    basis = SplineBasis.clamped(poses.shape[1], 7)
    coefficients = basis.fit(poses)
    weights, keep = optimised_weights(clip.skeleton, basis, coefficients, (np.ones(poses.shape[2]),), Keep())
    reconstruction_errors(clip.skeleton, find_components(basis, coefficients, weights, keep), poses, 1)


def _search(clip: Clip) -> None:
    """Compile the kernels of searches: search for two steps in a model of a single motion, and refine the result."""
    from marey_motion.modelling.mixture import LatentMixture
    from marey_motion.modelling.primitive import FunctionalComponents, MotionPrimitive
    from marey_motion.modelling.search.step_search import search_steps
    from marey_motion.modelling.search.steps import Step
    from marey_motion.modelling.search.tree import END_EFFECTORS, build_tree
    from marey_motion.modelling.splines import SplineBasis
    from marey_motion.motion import Motion
    from marey_motion.rigs import map_joints
    from marey_schemas.options.modelling import TreeOptions
    from marey_schemas.search_constraints import RootPositionConstraint

    def alone(values: NDArray[np.float64]) -> FunctionalComponents:
        basis = SplineBasis.clamped(len(values), 7)
        mean = basis.fit(values)
        directions = np.ones((1, *mean.shape)) / mean.size
        return FunctionalComponents(basis, mean, directions, directions, np.ones(1), np.ones(1))

    poses = Motion.of(clip).poses
    mixture = LatentMixture(np.ones(1), np.zeros((1, 2)), 1e-4 * np.eye(2)[None])
    space, time = alone(poses), alone(np.zeros((len(poses) - 1, 1)))
    primitive = MotionPrimitive("walk", clip.skeleton, clip.frame_rate_hz, space, time, 1.0, mixture)
    joints = {name: clip.skeleton.index_of(joint) for name, joint in map_joints(clip.skeleton).joints.items()}
    tree = build_tree(primitive, 0, TreeOptions(samples=64), end_effectors=[joints[name] for name in END_EFFECTORS])
    step = Step(primitive, (RootPositionConstraint(at="end", target_m=(0.0, None)),), joints)
    search_steps([step, step], [tree, tree])


STAGES: Mapping[str, Callable[[Clip], None]] = {
    "files": _read,
    "editing": _edit,
    "matching": _match,
    "searches": _search,
    "models": _model,
    "alignment": _align,
    "coverage": _measure,
    "perception": _perceive,
    "similarity": _find_similar,
}
"""Functions that use kernels, by name.

The first function compiles kernels that the other functions need, too. The other functions are sorted by duration, the
longest first.
"""


def main() -> None:
    """Compile everything, or only the stages named in the arguments."""
    parser = argparse.ArgumentParser(prog="python -m marey_motion.warm_up", description=__doc__)
    parser.add_argument("stages", nargs="*", metavar="stage", help=f"stages to run: {', '.join(STAGES)}; default: all")
    parser.add_argument("--processes", type=int, default=1, help="number of parallel processes; default: 1")
    arguments = parser.parse_args()
    if unknown := set(arguments.stages) - set(STAGES):
        parser.error(f"unknown stages: {', '.join(sorted(unknown))}; the stages are {', '.join(STAGES)}")
    if not arguments.stages and kernels_are_compiled():
        return
    discard_outdated_kernels()
    compile_kernels(arguments.stages or tuple(STAGES), arguments.processes)
    if not arguments.stages:
        _record(_DONE)


if __name__ == "__main__":
    main()
