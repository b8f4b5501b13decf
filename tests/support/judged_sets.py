"""Sets of generated clips with a known flaw, evaluated on a few short trials, for tests of verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import radians

import numpy as np

from marey_motion.clip import Clip
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import assemble, run_suite
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.rigs import map_joints
from marey_schemas.options.evaluation import EvaluationOptions

FEW = EvaluationOptions(
    speeds_m_s=(1.5, 2.0), turn_rates_deg_s=(-75.0, 0.0, 50.0), duration_s=6.0, families=("circle",), replicates=1
)
"""Options of six trials: straight lines, gentle turns and sharp turns."""


def walks(options: EvaluationOptions = FEW, seconds: float = 8.0) -> list[Clip]:
    """Return a generated gait for every cell of the grid."""
    cells = [(speed, turn) for speed in options.speeds_m_s for turn in options.turn_rates_deg_s]
    return [generate_gait(speed, radians(turn), seconds) for speed, turn in cells]


def frozen(clip: Clip, frame: int = 10) -> Clip:
    """Return a clip that travels as before, but whose body keeps the pose of one frame."""
    poses = clip.poses.copy()
    poses[:, 1] = poses[frame, 1]
    poses[:, 7:] = poses[frame, 7:]
    return replace(clip, poses=poses)


def gliding(clip: Clip, factor: float = 1.3) -> Clip:
    """Return a clip whose root travels farther than its steps, by a factor."""
    poses = clip.poses.copy()
    poses[:, (0, 2)] *= np.float32(factor)
    return replace(clip, poses=poses)


def database_of(clips: Sequence[Clip], options: EvaluationOptions = FEW) -> MatchingDatabase:
    """Return the database of some clips of one skeleton."""
    skeleton = clips[0].skeleton
    sources = [SourceClip(f"clip-{number:03}", f"clip {number}", clip) for number, clip in enumerate(clips)]
    return build_database(sources, MatchingBody.from_mapping(skeleton, map_joints(skeleton)), options.database)


def evaluated_set(clips: Sequence[Clip], options: EvaluationOptions = FEW) -> EvaluationResult:
    """Return the evaluation of some clips, without a baseline."""
    database, trials = database_of(clips, options), suite_trials(options)
    return assemble(database, options, trials, run_suite(database, options, trials=trials, threads=1))
