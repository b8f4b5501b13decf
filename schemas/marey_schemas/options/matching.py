"""Options of motion matching: how clips become a database, and how a controller plays it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Request

Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False, description="Weight of these features.")]


class FeatureWeightParams(Request):
    """How much each group of features counts in the cost of a match."""

    left_foot_position: Weight = 0.75
    right_foot_position: Weight = 0.75
    left_foot_velocity: Weight = 1.0
    right_foot_velocity: Weight = 1.0
    hip_velocity: Weight = 1.0
    trajectory_positions: Weight = 1.0
    trajectory_directions: Weight = 1.5


class DatabaseParams(Request):
    """How clips become a database for motion matching."""

    mirroring: Literal["none", "add", "only"] = Field(
        "none", description="add: a mirrored twin of every clip beside it; only: the twins alone."
    )
    end_policy: Literal["clamp", "trim", "loop"] = Field(
        "clamp", description="What rows near a clip's end look ahead to: its last frame, nothing, or its beginning."
    )
    root_mode: Literal["simulated", "bone"] = Field(
        "simulated", description="bone: the root joint moves as the character does, in data made so."
    )
    weights: FeatureWeightParams = FeatureWeightParams()
    horizons_s: tuple[Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)], ...] = Field(
        (1 / 3, 2 / 3, 1.0), min_length=1, max_length=8, description="How far ahead the trajectory is looked at."
    )
    extra_joints: tuple[Annotated[str, StringConstraints(min_length=1, max_length=64)], ...] = Field(
        (), max_length=16, description="Standard joints matched beside feet and hips; many drown the trajectory."
    )
    keep_rest_poses: bool = Field(False, description="Keep frames that look like calibration or a T-pose.")


class ControllerParams(Request):
    """How motion matching plays the database."""

    follow: Literal["time", "path", "open_loop"] = Field(
        "time",
        description="What is asked for: the trajectory at the same time, from its nearest point, or only its speed and "
        "turn rate.",
    )
    search_every_s: float = Field(0.1, gt=0, le=2, allow_inf_nan=False, description="Period of the search.")
    continuing_bias: float = Field(
        0.0, ge=-1000, le=1000, allow_inf_nan=False, description="Added to the cost of going on; negative favours it."
    )
    switch_margin: float = Field(
        1e-4, ge=0, le=1000, allow_inf_nan=False, description="A switch must be cheaper by more than this."
    )
    reselect_window_s: float = Field(
        0.0, ge=0, le=10, allow_inf_nan=False, description="Frames so near the current one are not chosen."
    )
    half_life_s: float = Field(0.1, gt=0, le=5, allow_inf_nan=False, description="Of what is blended at a switch.")
    root_inertialisation: bool = Field(True, description="Blend the root's velocity, too.")
    selection: Literal["features", "pose_distance"] = Field(
        "features", description="pose_distance: the published cost, the summed distance of joints in metres."
    )
    root_adjustment: float = Field(
        0.0, ge=0, le=1, allow_inf_nan=False, description="Pulls towards the reference; hides what is measured."
    )
    root_clamp_m: float | None = Field(
        None, gt=0, le=100, allow_inf_nan=False, description="Holds the character so near; hides what is measured."
    )
