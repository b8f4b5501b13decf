"""Generated clips that own every cell of a grid: what a data set that holds all it is asked for reaches."""

from __future__ import annotations

from dataclasses import replace
from math import radians

from marey_motion.errors import MotionError
from marey_motion.evaluation.options import EvaluationOptions
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.rigs import map_joints

CLIP_S = 8.0


def baseline_clips(options: EvaluationOptions) -> tuple[list[SourceClip], list[str]]:
    """A gait for each pair of the grid, and of the speed that trials switch to; and notes on those nobody can walk."""
    speeds = set(options.grid.speeds_m_s)
    if "switching" in options.families:
        speeds.add(options.switch_speed_m_s)
    clips: list[SourceClip] = []
    notes: list[str] = []
    for speed in sorted(speeds):
        for turn_rate in sorted(set(options.grid.turn_rates_deg_s)):
            name = f"v={speed:g} w={turn_rate:g}"
            try:
                clip = generate_gait(speed, radians(turn_rate), CLIP_S, options.database.rate_hz)
            except MotionError as error:
                if error.code != "gait-out-of-reach":
                    raise
                notes.append(f"no generated clip for {name}: {error.message}")
                continue
            clips.append(SourceClip(uid=f"gait-{len(clips):04d}", name=name, clip=clip))
    return clips, notes


def baseline_database(options: EvaluationOptions) -> tuple[MatchingDatabase, list[str]]:
    """The generated clips as a database, with a normaliser of their own."""
    clips, notes = baseline_clips(options)
    if not clips:
        raise MotionError("no generated clip can do what the grid asks", where="grid")
    skeleton = clips[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(clips, body, replace(options.database, mirroring="none")), notes
