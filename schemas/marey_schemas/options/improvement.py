"""Options of what improves a set of clips: suggestions, optimisations, sweeps of weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marey_schemas.base import Options

_Price = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
_Factor = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class ObjectiveOptions(Options):
    """Weights of the objective, the cost of a set of clips in metres: the smaller, the better."""

    offset: _Price = Field(1.0, description="Weight of the mean distance from where the character should be.")
    abs_se_v: _Price = Field(0.5, description="Metres that a speed error of 1 m/s counts as.")
    abs_se_omega_deg: _Price = Field(0.005, description="Metres that a turn rate error of 1 degree/s counts as.")
    pose_cost: _Price = Field(0.5, description="Metres that a metre of pose cost counts as.")
    seconds: _Price = Field(
        0.0001, description="Metres that a second of data counts as; a clip that helps by less than this goes."
    )


class ObjectiveChoice(Options):
    """The objective that a computation makes smaller."""

    objective: ObjectiveOptions = Field(ObjectiveOptions(), description="Weights of the objective.")


class SuggestionOptions(ObjectiveChoice):
    """Suggestions to look for."""

    removals: int = Field(
        10,
        ge=0,
        le=1000,
        description="Number of removals to plan one after another, once unused clips are gone; 0: none.",
    )
    consider: int | None = Field(
        50,
        ge=0,
        le=100_000,
        description="Number of clips to leave out in turn, those that the fewest trials need; null: all.",
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
        description="Greatest distance between poses that blend, summed over joints, in metres; absent: the median "
        "over the transitions of the trials.",
    )


class OptimisationOptions(ObjectiveChoice):
    """Limits of an optimisation."""

    least_gain: float = Field(
        1e-4,
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="End when no step lowers the objective by so many metres.",
    )
    max_steps: int = Field(50, ge=1, le=10_000, description="End after so many steps.")
    max_evaluations: int | None = Field(
        None, ge=1, le=1_000_000, description="End after so many sets of clips were tried; null: any number."
    )
    max_data_s: float | None = Field(
        None,
        gt=0,
        le=1e7,
        allow_inf_nan=False,
        description="Longest set in seconds: nothing is added that makes it longer; null: any length.",
    )
    consider: int | None = Field(
        20,
        ge=1,
        le=100_000,
        description="Number of removals and number of additions to try in each step; null: all.",
    )


class SweepOptions(ObjectiveChoice):
    """Settings of the weights that a sweep tries."""

    factors: tuple[_Factor, ...] = Field(
        (0.5, 2.0),
        min_length=1,
        max_length=20,
        description="Each group of features is matched with its weight times each of these, all others as they are.",
    )
