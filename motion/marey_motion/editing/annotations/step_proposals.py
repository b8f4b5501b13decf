"""Proposals of segments for the steps of a walk or run, for people to review."""

from __future__ import annotations

from itertools import pairwise
from math import cos, degrees, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import Stance, find_stances
from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs.standard import SIDES
from marey_schemas.options.annotations import ContactOptions, StepsProposal

STANDING = "standing"
PASSING = "passing"
SHORTEST_FLIGHT_S = 0.04


def propose_steps(clip: Clip, body: MatchingBody, options: StepsProposal | None = None) -> Layer:
    """Propose a segment for each step: from the contact of one foot to the next contact of the other foot.

    The label names the foot that swings. `step_left` and `step_right` are steps of a walk; `run_left` and `run_right`
    are steps with a phase in which no foot touches the ground. The first step after standing has the prefix `start_`
    and begins where the foot leaves the ground; the last step before standing has the prefix `stop_`; a step with
    standing before and after it has the prefix `single_`. Periods of standing have the label `standing`. Incomplete
    steps, turns on the spot, jumps, side steps and backward steps have no segment. The keyframe `passing` marks the
    frame in which the swinging foot passes the other foot, if there is such a frame.

    Parameters
    ----------
    clip : Clip    F frames
    body : MatchingBody    joints of its skeleton
    options : StepsProposal, optional    limits

    Returns
    -------
    Layer    the proposal
    """
    options = options or StepsProposal()
    stances = find_stances(clip, body, ContactOptions(speed_m_s=options.contact_speed_m_s))
    standing = _standing(stances, clip, options.standing_s)
    travel = _Travel.of(clip, body)
    steps = [step for step in _steps(stances, standing) if travel.is_step(step, options)]
    flying = _flying(stances, clip.frame_count)
    labels = [_label(step, _has_flight(step, flying, clip.frame_rate_hz)) for step in steps]
    named = [(label, step) for label, step in zip(labels, steps, strict=True) if label]
    passing = [frame for _, step in named if (frame := travel.passing(step)) is not None]
    return Layer(
        clip.frame_count,
        (
            *(Segment(label, step.start, step.end) for label, step in named),
            *(Segment(STANDING, *one) for one in standing),
        ),
        tuple(Keyframe(PASSING, frame) for frame in passing),
    )


class _Step(NamedTuple):
    """Step in which a foot swings from frame `start` and touches the ground at frame `end`.

    `side` is 0 for the left and 1 for the right foot. `from_standing` is true if the body is at rest before the
    step, `to_standing` if it is at rest after the step.
    """

    side: int
    start: int
    end: int
    from_standing: bool
    to_standing: bool


def _standing(stances: tuple[list[Stance], ...], clip: Clip, standing_s: float) -> list[Stance]:
    """Find the periods of at least `standing_s` seconds in which both feet are on the ground.

    `stances` are the stances of the left and of the right foot.
    """
    both = [Stance(max(a.start, b.start), min(a.end, b.end)) for a in stances[0] for b in stances[1]]
    return sorted(one for one in both if one.end - one.start >= max(1.0, standing_s * clip.frame_rate_hz))


def _steps(stances: tuple[list[Stance], ...], standing: list[Stance]) -> list[_Step]:
    """Find the steps, each from a contact to the next contact of the other foot.

    A step after standing begins where the foot leaves the ground. A stance that includes the first frame of the clip
    does not count as a contact, since its start is unknown.
    """
    begins, ends = {one.start for one in standing}, {one.end for one in standing}
    lifts = [{after.start: before.end for before, after in pairwise(of_side)} for of_side in stances]
    strikes = sorted((one.start, side) for side, of_side in enumerate(stances) for one in of_side if one.start > 0)
    found: list[_Step] = []
    for number, (strike, side) in enumerate(strikes):
        lift, before = lifts[side].get(strike), strikes[number - 1] if number else None
        if lift in ends:
            found.append(_Step(side, lift, strike, True, strike in begins))
        elif lift is not None and before is not None and before[1] != side and before[0] < strike:
            found.append(_Step(side, before[0], strike, False, strike in begins))
    return [step for step in found if not any(one.start < step.end and step.start < one.end for one in standing)]


def _flying(stances: tuple[list[Stance], ...], frame_count: int) -> NDArray[np.bool_]:
    """Find the frames (F,) in which no foot touches the ground."""
    flying = np.ones(frame_count, dtype=np.bool_)
    for stance in (one for of_side in stances for one in of_side):
        flying[stance.start : stance.end] = False
    return flying


def _has_flight(step: _Step, flying: NDArray[np.bool_], frame_rate_hz: float) -> bool:
    return int(flying[step.start : step.end].sum()) >= max(1.0, SHORTEST_FLIGHT_S * frame_rate_hz)


def _label(step: _Step, has_flight: bool) -> str | None:
    """Choose the label of a step; None for a jump, in which both feet leave the ground after standing."""
    if has_flight:
        manner = None if step.from_standing else "run"
    elif step.from_standing:
        manner = "single" if step.to_standing else "start"
    else:
        manner = "stop" if step.to_standing else "step"
    return manner and f"{manner}_{SIDES[step.side]}"


class _Travel(NamedTuple):
    """Ground positions of hips (F, 2) and ankles (F, 2, 2), metres; headings (F,), radians; and frames per second."""

    hips: NDArray[np.float64]
    ankles: NDArray[np.float64]
    heading: NDArray[np.float64]
    frame_rate_hz: float

    @classmethod
    def of(cls, clip: Clip, body: MatchingBody) -> _Travel:
        positions = kinematics.global_positions(clip).astype(np.float64)
        directions = kinematics.forward_directions(positions, body.lefts, body.rights)
        ground = np.asarray(kinematics.ground_projection(positions), dtype=np.float64)
        heading = kinematics.headings(directions)
        return cls(ground[:, body.hips], ground[:, list(body.feet)], heading, clip.frame_rate_hz)

    def is_step(self, step: _Step, options: StepsProposal) -> bool:
        """Return whether the movement is one step forward and not a turn."""
        if not options.shortest_s <= (step.end - step.start) / self.frame_rate_hz <= options.longest_s:
            return False
        way = self.hips[step.end] - self.hips[step.start]
        length = float(np.hypot(*way))
        if length < max(options.shortest_m, 1e-6):
            return False
        heading = self.heading[step.start : step.end + 1]
        middle = float(heading.mean())
        ahead = float(way @ (np.sin(middle), np.cos(middle))) / length
        turned = degrees(abs(heading[-1] - heading[0]))
        return ahead >= cos(radians(options.most_aside_deg)) and turned <= options.most_turn_deg

    def passing(self, step: _Step) -> int | None:
        """Find the first frame in which the swinging foot is ahead of the other foot.

        Returns None if the swinging foot is ahead from the start of the step, or never.
        """
        swing, stand = (self.ankles[step.start : step.end, side] for side in (step.side, 1 - step.side))
        ahead = (swing - stand) @ (self.hips[step.end] - self.hips[step.start]) > 0.0
        if ahead[0] or not ahead.any():
            return None
        return step.start + int(np.argmax(ahead))
