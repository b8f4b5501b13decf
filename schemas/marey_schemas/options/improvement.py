"""Options of improvements of a set of clips: suggestions, optimisations, sweeps of weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marey_schemas.base import Options

_Price = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
_Factor = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class ObjectiveOptions(Options):
    """Weights of the objective, which is the cost of a set of clips in metres; a smaller cost is better."""

    offset: _Price = Field(1.0, description="Weight of the mean distance between the character and its reference.")
    abs_se_v: _Price = Field(0.5, description="Metres that a speed error of 1 m/s adds to the objective.")
    abs_se_omega_deg: _Price = Field(
        0.005, description="Metres that a turn rate error of 1 degree/s adds to the objective."
    )
    pose_cost: _Price = Field(0.5, description="Metres that a pose cost of 1 m adds to the objective.")
    seconds: _Price = Field(
        0.0001,
        description="Metres that each second of data adds to the objective; a clip that lowers the other terms by less "
        "is removed.",
    )


class ObjectiveChoice(Options):
    """Objective that a computation minimises."""

    objective: ObjectiveOptions = Field(
        ObjectiveOptions(), description="Weights of the objective: the cost of a set of clips."
    )


class SuggestionOptions(ObjectiveChoice):
    """Options that select the suggestions to compute."""

    removals: int = Field(
        10,
        ge=0,
        le=1000,
        description="Number of clips whose removal is planned, in addition to the unused clips; 0: none.",
    )
    consider: int | None = Field(
        50,
        ge=0,
        le=100_000,
        description="Number of clips whose removal is tried, one at a time, beginning with the clips that the fewest "
        "trials use; null: all.",
    )
    duplicate_cm: float = Field(
        3.0,
        ge=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest distance per frame between near-duplicates, in centimetres.",
    )
    blendable_m: float | None = Field(
        None,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest distance between poses that can be blended, summed over joints, in metres; "
        "absent: the median over the transitions of the trials.",
    )
    blendable_distance: float | None = Field(
        None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="With a metric, instead of `blendable_m`: greatest perceptual distance between poses that can be "
        "blended; absent: the median over the transitions of the trials.",
    )
    lost_pose: _Price = Field(
        0.01,
        description="With a metric: metres that each second of poses that look like no pose of the remaining clips "
        "adds to the harm of a removal.",
    )


class OptimisationOptions(ObjectiveChoice):
    """Limits of an optimisation."""

    least_gain: float = Field(
        1e-4,
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="The optimisation ends when no step lowers the objective by at least this many metres.",
    )
    max_steps: int = Field(50, ge=1, le=10_000, description="Greatest number of steps.")
    max_evaluations: int | None = Field(
        None, ge=1, le=1_000_000, description="Greatest number of sets of clips to try; null: no limit."
    )
    max_data_s: float | None = Field(
        None,
        gt=0,
        le=1e7,
        allow_inf_nan=False,
        description="Greatest duration of the set in seconds; no clip is added that would exceed this duration; "
        "null: no limit.",
    )
    consider: int | None = Field(
        20,
        ge=1,
        le=100_000,
        description="Number of removals and number of additions to try in each step; null: all.",
    )


class SweepOptions(ObjectiveChoice):
    """Options of a sweep: the weights of feature groups to try."""

    factors: tuple[_Factor, ...] = Field(
        (0.5, 2.0),
        min_length=1,
        max_length=20,
        description="Factors to try. Each setting multiplies the weight of one group of features by one factor and "
        "leaves all other weights unchanged.",
    )
