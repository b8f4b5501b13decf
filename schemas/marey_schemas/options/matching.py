"""Options of motion matching: the database of clips, and the controller that plays clips from the database."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, StringConstraints, field_validator, model_validator

from marey_schemas.base import Options

EndPolicy = Literal["clamp", "trim", "loop"]
Mirroring = Literal["none", "add", "only"]
RootMode = Literal["simulated", "bone"]
Selection = Literal["features", "pose_distance"]
Follow = Literal["time", "path", "open_loop"]
FOLLOW_MODES: tuple[Follow, ...] = get_args(Follow)

TICK_RATE_HZ = 60.0
"""Default rate of the features and of the simulation, in hertz."""

_Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
_OF_GROUP = "Weight of the {} in the cost of a match; 0 leaves it out."


class FeatureWeights(Options):
    """Weights of the groups of features in the cost of a match, in the order of the features in the database."""

    left_foot_position: _Weight = Field(0.75, description=_OF_GROUP.format("position of the left foot"))
    right_foot_position: _Weight = Field(0.75, description=_OF_GROUP.format("position of the right foot"))
    left_foot_velocity: _Weight = Field(1.0, description=_OF_GROUP.format("velocity of the left foot"))
    right_foot_velocity: _Weight = Field(1.0, description=_OF_GROUP.format("velocity of the right foot"))
    hip_velocity: _Weight = Field(1.0, description=_OF_GROUP.format("velocity of the hips"))
    trajectory_positions: _Weight = Field(1.0, description=_OF_GROUP.format("positions of the trajectory ahead"))
    trajectory_directions: _Weight = Field(1.5, description=_OF_GROUP.format("directions of the trajectory ahead"))
    extra_joints: _Weight = Field(
        1.0,
        description="Weight in the cost of a match of the position, and of the velocity, of each joint in the option "
        "`extra_joints` of the database; 0 leaves these joints out.",
    )


class DatabaseOptions(Options):
    """Options of the conversion of clips to a database for motion matching."""

    mirroring: Mirroring = Field(
        "none",
        description="Mirrored copies of the clips. none: the clips alone; add: every clip and its mirrored "
        "copy; only: the mirrored copies alone.",
    )
    end_policy: EndPolicy = Field(
        "clamp",
        description="Handling of the end of a clip, where its future trajectory is unknown. clamp: the last frame is "
        "repeated, and the last 1/3 s is not selected; trim: frames after which the clip ends before the last of "
        "`horizons_s` are not selected; loop: in clips that are marked as loops, the beginning follows the end; other "
        "clips are treated as by clamp.",
    )
    root_mode: RootMode = Field(
        "simulated",
        description="Source of the character's motion on the ground. simulated: the smoothed position and heading of "
        "the body; bone: the root joint, for data whose root joint moves as the character does.",
    )
    weights: FeatureWeights = Field(FeatureWeights(), description="Weight of each group of features.")
    horizons_s: tuple[Annotated[float, Field(gt=0, le=3, allow_inf_nan=False)], ...] = Field(
        (1 / 3, 2 / 3, 1.0),
        min_length=1,
        max_length=8,
        description="Times after the current frame at which trajectories are compared, in seconds, increasing.",
    )
    extra_joints: tuple[Annotated[str, StringConstraints(min_length=1, max_length=64)], ...] = Field(
        (),
        max_length=16,
        description="Standard joints to match in addition to feet and hips; with many joints the trajectory has too "
        "little weight.",
    )
    rate_hz: float = Field(
        TICK_RATE_HZ,
        ge=10,
        le=240,
        allow_inf_nan=False,
        description="Rate of the features and of the simulation, in hertz.",
    )
    keep_rest_poses: bool = Field(
        False, description="Keep frames at the beginning and end of a clip that look like a calibration or a T-pose."
    )

    @field_validator("horizons_s")
    @classmethod
    def _check_order(cls, horizons_s: tuple[float, ...]) -> tuple[float, ...]:
        if any(after <= before for before, after in pairwise(horizons_s)):
            raise ValueError("the times must be in increasing order")
        return horizons_s

    @field_validator("extra_joints")
    @classmethod
    def _check_names(cls, extra_joints: tuple[str, ...]) -> tuple[str, ...]:
        repeated = next((name for name, count in Counter(extra_joints).items() if count > 1), None)
        if repeated is not None:
            raise ValueError(f"the list contains the joint {repeated!r} more than once; remove the repetitions")
        return extra_joints

    @model_validator(mode="after")
    def _check_horizons(self) -> Self:
        ticks = [0, *(round(horizon_s * self.rate_hz) for horizon_s in self.horizons_s)]
        if any(after <= before for before, after in pairwise(ticks)):
            raise ValueError(
                "horizons_s: the first time, and the distances between successive times, must be at least one "
                f"frame (1/{self.rate_hz:g} s)"
            )
        return self


class ControllerOptions(Options):
    """Options of the controller that selects and plays frames of a database for motion matching."""

    follow: Follow = Field(
        "time",
        description="Points that each search asks for at the times `horizons_s` ahead, from the reference (the "
        "trajectory to follow). time: where the reference is at these times; path: points of the reference, measured "
        "from the point nearest to the character; open_loop: points that the character reaches from its present "
        "position with the speed and turn rate of the reference.",
    )
    search_every_s: float = Field(
        0.1,
        gt=0,
        le=2,
        allow_inf_nan=False,
        description="Seconds from one search of the clips for the best frame to the next search.",
    )
    continuing_bias: float = Field(
        0.0,
        ge=-1000,
        le=1000,
        allow_inf_nan=False,
        description="Value added to the cost of continuing the current clip; negative values favour continuing.",
    )
    switch_margin: float = Field(
        1e-4,
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="Least reduction of the cost for which the character switches to another clip or frame.",
    )
    reselect_window_s: float = Field(
        1 / 3,
        ge=0,
        le=10,
        allow_inf_nan=False,
        description="Seconds around the current frame that a search does not select, so that the character does not "
        "tread on the spot; 0 allows all frames.",
    )
    half_life_s: float = Field(
        0.1,
        gt=0,
        le=5,
        allow_inf_nan=False,
        description="Half-life, in seconds, with which the difference between the old and the new motion decays "
        "after a switch.",
    )
    root_inertialisation: bool = Field(
        True, description="Whether the blend after a switch also includes the root's velocity."
    )
    selection: Selection = Field(
        "features",
        description="Cost that each search minimises. features: the squared distance of the weighted features; "
        "pose_distance: the same for the features of the trajectory only, plus the distances, in metres, between the "
        "joints of the current pose and those of the pose to which the character would switch, as in Abichequer "
        "Sangalli et al. (2022).",
    )
    root_adjustment: float = Field(
        0.0,
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="Rate, per second, at which the character is pulled to the trajectory that it follows: "
        "within a second, the distance shrinks by the factor exp(-rate). This hides tracking errors. "
        "0: it is not pulled.",
    )
    root_clamp_m: float | None = Field(
        None,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest distance of the character from the trajectory that it follows, in metres; this "
        "hides tracking errors. Absent: no limit.",
    )
