"""What can be chosen about a matching database and the controller that plays it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

EndPolicy = Literal["clamp", "trim", "loop"]
Mirroring = Literal["none", "add", "only"]
RootMode = Literal["simulated", "bone"]
Selection = Literal["features", "pose_distance"]
Follow = Literal["time", "path", "open_loop"]

TICK_RATE_HZ = 60.0
"""Rate of features and simulation."""
HORIZONS_S = (1 / 3, 2 / 3, 1.0)
"""How far ahead the trajectory is looked at."""


@dataclass(frozen=True)
class FeatureWeights:
    """Weight of each group of features; the groups in the order of the 27 dimensions of the default layout.

    `extra_joints` is that of each position and each velocity of these. A weight of 0 leaves a group out of all costs.
    """

    left_foot_position: float = 0.75
    right_foot_position: float = 0.75
    left_foot_velocity: float = 1.0
    right_foot_velocity: float = 1.0
    hip_velocity: float = 1.0
    trajectory_positions: float = 1.0
    trajectory_directions: float = 1.5
    extra_joints: float = 1.0


@dataclass(frozen=True)
class DatabaseOptions:
    """How clips become a database.

    Parameters
    ----------
    mirroring : "add" doubles the clips by mirrored ones, "only" keeps the mirrored ones
    end_policy : what the rows near a clip's end look ahead to: the last frame ("clamp", the last 1/3 s is not
        selectable), nothing ("trim", the last second is not selectable), or the clip's own beginning ("loop", for the
        clips marked as loops; the others clamp)
    root_mode : "bone" takes the root joint itself as the root's motion, for data that has one
    extra_joints : standard joints whose position and velocity are matched beside feet and hips; more than five matched
        joints drown the trajectory
    keep_rest_poses : keep the rest poses that a clip begins or ends with, which are left out otherwise
    """

    mirroring: Mirroring = "none"
    end_policy: EndPolicy = "clamp"
    root_mode: RootMode = "simulated"
    weights: FeatureWeights = field(default_factory=FeatureWeights)
    horizons_s: tuple[float, ...] = HORIZONS_S
    extra_joints: tuple[str, ...] = ()
    rate_hz: float = TICK_RATE_HZ
    keep_rest_poses: bool = False


@dataclass(frozen=True)
class ControllerOptions:
    """How motion matching plays a database (evaluation.md 1.2's knobs).

    Parameters
    ----------
    follow : what the wished trajectory is taken from; see `marey_motion.evaluation.scenario`
    search_every_s : search period
    continuing_bias : added to the cost of going on; negative favours it
    switch_margin : a switch must be cheaper than going on by more than this
    reselect_window_s : frames so near the current one cannot be chosen by a search
    half_life_s : of the inertialised offsets
    root_inertialisation : whether the root's velocity is blended, too
    selection : "features", or "pose_distance": the paper's literal cost, the summed distance of the pose joints in
        metres, beside the trajectory features
    root_adjustment : pull the character towards the reference, by this share of its distance per second; off (0) in
        evaluations, since it hides what is measured
    root_clamp_m : hold it within so many metres; off (None) in evaluations for the same reason
    """

    follow: Follow = "time"
    search_every_s: float = 0.1
    continuing_bias: float = 0.0
    switch_margin: float = 1e-4
    reselect_window_s: float = 0.0
    half_life_s: float = 0.1
    root_inertialisation: bool = True
    selection: Selection = "features"
    root_adjustment: float = 0.0
    root_clamp_m: float | None = None
