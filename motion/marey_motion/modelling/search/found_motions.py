"""Motions of latent vectors that a search found, in the world and in real time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion import quaternions
from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.constraints import InvalidConstraint, frame_at
from marey_motion.modelling.search.step_search import Sequel
from marey_motion.modelling.search.steps import Step
from marey_motion.motion import Motion
from marey_motion.skeleton import SAME_OFFSET_M, Skeleton, same_hierarchy
from marey_schemas.search_constraints import Moment


@dataclass(frozen=True, eq=False)
class FoundMotion:
    """One motion over consecutive steps.

    Parameters
    ----------
    motion : F frames in the world; the last frame of a step is the first frame of the next step
    starts : first frame of each step
    passed : for each step, frames of real time (N,) that have passed at each canonical frame
    """

    skeleton: Skeleton
    frame_rate_hz: float
    motion: Motion
    starts: tuple[int, ...]
    passed: tuple[Floats, ...]

    def frame_of(self, step: int, primitive: MotionPrimitive, at: Moment) -> int:
        """Find the frame of the motion that is nearest to a given time of a step.

        Parameters
        ----------
        step : int    number of the step
        primitive : MotionPrimitive    the model of the step
        at : str or float    label of a keyframe, "start", "end", or a canonical frame

        Returns
        -------
        int    frame of the motion
        """
        passed = self.passed[step]
        place = float(np.interp(frame_at(primitive, at), np.arange(len(passed)), passed))
        share = place / passed[-1]
        length: int = round(share * self._length(step))
        return self.starts[step] + length

    def _length(self, step: int) -> int:
        """Count the frames of a step, without its first frame."""
        ends = (*self.starts[1:], self.motion.frame_count - 1)
        return ends[step] - self.starts[step]


def found_motion(steps: Sequence[Step], sequel: Sequel) -> FoundMotion:
    """Join the motions of all steps.

    Parameters
    ----------
    steps : sequence of Step    the steps, for their models
    sequel : Sequel    latent vectors and placements found for them

    Returns
    -------
    FoundMotion    one motion in the world

    Raises
    ------
    InvalidConstraint    if steps have different skeletons or frame rates
    MotionError    if the motion of a step would have too many frames
    """
    first = steps[0].primitive
    for number, step in enumerate(steps):
        if not same_hierarchy(step.primitive.skeleton, first.skeleton, tolerance_m=SAME_OFFSET_M):
            raise InvalidConstraint(
                "the model of this step was made for another skeleton than the model of the first step; "
                "use models of one skeleton",
                where=f"steps[{number}]",
            )
        if step.primitive.frame_rate_hz != first.frame_rate_hz:
            rates = f"{step.primitive.frame_rate_hz:g} Hz, the first step's {first.frame_rate_hz:g} Hz"
            raise InvalidConstraint(
                f"the models of all steps need the same frame rate; the model of this step has {rates}",
                where=f"steps[{number}]",
            )
    placed = [
        _placed(step.primitive.motions(latent[None])[0], placement)
        for step, latent, placement in zip(steps, sequel.latents, sequel.measured.placements, strict=True)
    ]
    kept = [placed[0], *(motion.at_frames(np.arange(1, motion.frame_count)) for motion in placed[1:])]
    lengths = [motion.frame_count - 1 for motion in placed]
    return FoundMotion(
        skeleton=first.skeleton,
        frame_rate_hz=first.frame_rate_hz,
        motion=_in_a_row(kept),
        starts=tuple(np.cumsum([0, *lengths[:-1]]).tolist()),
        passed=tuple(
            step.primitive.time_functions(latent[None])[0] for step, latent in zip(steps, sequel.latents, strict=True)
        ),
    )


def _placed(motion: Motion, placement: Placement) -> Motion:
    """Move a motion from canonical coordinates to the world, turned and shifted as a whole."""
    turn = quaternions.from_axis_angle((0.0, 1.0, 0.0), placement.heading_rad)
    origin = np.array((placement.x, placement.y, placement.z))
    roots = quaternions.rotate_vectors(turn, motion.root_translations) + origin
    rotations = motion.rotations.copy()
    rotations[:, 0] = quaternions.multiply(turn, rotations[:, 0])
    return motion._replace(root_translations=np.asarray(roots, dtype=np.float64), rotations=rotations)


def _in_a_row(motions: Sequence[Motion]) -> Motion:
    """Concatenate motions; the signs of quaternions are chosen so that they are continuous from motion to motion."""
    rotations = [motions[0].rotations]
    for motion in motions[1:]:
        agreeing = np.einsum("jc,jc->j", rotations[-1][-1], motion.rotations[0]) >= 0.0
        rotations.append(motion.rotations * np.where(agreeing, 1.0, -1.0)[:, None])
    roots, translations = (
        np.concatenate([getattr(motion, name) for motion in motions]) for name in ("root_translations", "translations")
    )
    return Motion(roots, np.concatenate(rotations), translations, ())
