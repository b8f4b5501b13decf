"""What can be asked about evaluations: comparisons, suggestions, optimisations, and sweeps of weights.

Jobs of these kinds answer with numbers for lists and name the file that holds everything, as `document`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.evaluation import FeatureWeightParams

WEIGHT_GROUPS = len(FeatureWeightParams.model_fields)

Price = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
Factor = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class CompareParams(Request):
    """Parameters of `compare`."""

    title: str = Field("", max_length=200, description="Of the report; default: the names of the two.")
    report: bool = Field(True, description="Write the report, a page of HTML that needs nothing else.")


class ObjectiveParams(Request):
    """What a set of clips costs, in metres: the less the better."""

    offset: Price = Field(1.0, description="Weight of the mean distance from where the character should be.")
    abs_se_v: Price = Field(0.5, description="Metres that an error of 1 m/s counts as.")
    abs_se_omega_deg: Price = Field(0.005, description="Metres that an error of 1 degree/s counts as.")
    pose_cost: Price = Field(0.5, description="Metres that a metre of pose cost counts as.")
    seconds: Price = Field(0.0001, description="Metres that a second of data counts as.")


class SuggestParams(Request):
    """Parameters of `suggest`."""

    objective: ObjectiveParams = ObjectiveParams()
    removals: int = Field(
        10,
        ge=0,
        le=1000,
        description="How many removals to plan after one another, once unused clips are gone; 0: none.",
    )
    consider: int | None = Field(
        50, ge=0, le=100_000, description="Leave out in turn only so many clips, those that fewest trials need."
    )
    duplicate_cm: float = Field(
        3.0, ge=0, le=100, allow_inf_nan=False, description="Clips up to so far apart per frame are near-duplicates."
    )
    blendable_m: float | None = Field(
        None,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Poses up to so far apart, summed over joints, blend; default: the median of the trials' switches.",
    )


class OptimiseParams(Request):
    """Parameters of `optimise`."""

    objective: ObjectiveParams = ObjectiveParams()
    least_gain: float = Field(
        1e-4, ge=0, le=1000, allow_inf_nan=False, description="End when no step lowers the objective by so many metres."
    )
    max_steps: int = Field(50, ge=1, le=10_000, description="End after so many steps.")
    max_evaluations: int | None = Field(
        None, ge=1, le=1_000_000, description="End after so many sets of clips were tried."
    )
    max_data_s: float | None = Field(
        None, gt=0, le=1e7, allow_inf_nan=False, description="Add nothing that makes the set longer, in seconds."
    )
    consider: int | None = Field(
        20, ge=1, le=100_000, description="Try only so many removals and so many additions in each step."
    )


class SweepParams(Request):
    """Parameters of `sweep`."""

    objective: ObjectiveParams = ObjectiveParams()
    factors: tuple[Factor, ...] = Field(
        (0.5, 2.0),
        min_length=1,
        max_length=20,
        description="Each group of features is matched with its weight times each of these, all others as they are.",
    )


def count_sweep_tasks(params: SweepParams) -> int:
    """A task for each setting of the weights."""
    return 1 + WEIGHT_GROUPS * len(params.factors)
