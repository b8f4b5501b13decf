"""Options of improvements of a set of clips: suggestions, optimisations, sweeps of weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from marey_schemas.base import Options
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.sizes import SEEDS

_Price = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
_Factor = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class ObjectiveOptions(Options):
    """Weights of the objective, which is the cost of a set of clips in metres; a smaller cost is better."""

    offset: _Price = Field(
        1.0, description="Weight of the mean distance between the character and the path that it follows."
    )
    abs_se_v: _Price = Field(0.5, description="Metres that a speed error of 1 m/s adds to the objective.")
    abs_se_omega_deg: _Price = Field(
        0.005, description="Metres that a turn rate error of 1 degree/s adds to the objective."
    )
    pose_cost: _Price = Field(0.5, description="Metres that a pose cost of 1 m adds to the objective.")
    seconds: _Price = Field(
        0.0001,
        description="Metres that each second of data adds to the objective. A clip is worth removing if it "
        "lowers the other terms by less than its duration adds.",
    )


class ObjectiveChoice(Options):
    """Base of options with the objective that suggestions, optimisations and sweeps minimise."""

    objective: ObjectiveOptions = Field(
        ObjectiveOptions(), description="Weights of the objective: the cost of a set of clips."
    )


class ConfirmedEffects(ObjectiveChoice):
    """Replicates in which effects are estimated, and further replicates in which the chosen effects are confirmed."""

    estimation_replicates: int = Field(
        4,
        ge=1,
        le=64,
        description="Number of replicates of each trial in which effects are estimated, in order to choose among "
        "them. These replicates are the first ones of the evaluation, and further ones if it has fewer. "
        "Confirmations use other replicates, which neither the estimate nor the evaluation uses.",
    )
    confirmation_replicates: int = Field(
        8,
        ge=0,
        le=64,
        description="Number of further replicates in which the chosen effects are measured again; these measurements "
        f"are reported, with intervals. At least {LEAST_REPLICATES}, or 0: effects are not confirmed. "
        f"{LEAST_REPLICATES} to 6 are too few to confirm a step of an optimisation that has the same effect in every "
        "replicate: for three candidates, the sign test needs 7. A step that changes no trial needs no confirmation.",
    )
    confirmation_seed: int = Field(
        0,
        ge=0,
        lt=SEEDS,
        description="Seed of the replicates for confirmation. With another seed, the same choices are confirmed in "
        "different replicates.",
    )

    @field_validator("confirmation_replicates")
    @classmethod
    def _check_confirmations(cls, count: int) -> int:
        if 0 < count < LEAST_REPLICATES:
            raise ValueError(
                f"{count} replicates are too few for an interval; choose at least {LEAST_REPLICATES}, or 0 to "
                "leave effects unconfirmed"
            )
        return count


class SuggestionOptions(ConfirmedEffects):
    """Options of `suggest`: how many suggestions are computed, and when clips count as duplicates."""

    removals: int = Field(
        10,
        ge=0,
        le=1000,
        description="Greatest number of removals to plan, in addition to the clips that no trial uses. Each step "
        "removes the clip whose removal harms least per second of data. Steps after the first compare only the clips "
        "whose removal harmed least in the steps before. 0: none.",
    )
    simulated_additions: int = Field(
        3,
        ge=0,
        le=100,
        description="Number of suggested additions whose effect on the trials is simulated: the first ones that have "
        "the skeleton of the set. Each simulation takes as long as an evaluation with `confirmation_replicates`.",
    )
    consider: int | None = Field(
        50,
        ge=0,
        le=100_000,
        description="Number of clips whose removal is tried, one clip at a time, beginning with the clips that the "
        "fewest trials use; null: all clips.",
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
        description="With a metric: metres that each second of lost poses adds to the harm of a removal. A pose "
        "is lost if it looks like no pose of the remaining clips.",
    )


class OptimisationOptions(ConfirmedEffects):
    """Limits of an optimisation of a set of clips: gain, steps, tries, and duration."""

    least_gain: float = Field(
        0.0,
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="Least decrease of the objective that a step must achieve, in metres. The value 0 is enough to "
        "exclude effects of chance, because every step must also be confirmed.",
    )
    max_steps: int = Field(50, ge=1, le=10_000, description="Greatest number of steps.")
    max_evaluations: int | None = Field(
        None, ge=1, le=1_000_000, description="Greatest number of sets of clips to try; absent: no limit."
    )
    max_data_s: float | None = Field(
        None,
        gt=0,
        le=1e7,
        allow_inf_nan=False,
        description="Greatest duration of the set in seconds; no clip is added that would exceed this duration; "
        "absent: no limit.",
    )
    consider: int | None = Field(
        20,
        ge=1,
        le=100_000,
        description="Number of removals, and number of additions, to try in each step; null: all.",
    )


class SweepOptions(ConfirmedEffects):
    """Options of a sweep: the weights of feature groups to try."""

    factors: tuple[_Factor, ...] = Field(
        (0.5, 2.0),
        min_length=1,
        max_length=20,
        description="Factors to try. Each setting multiplies the weight of one group of features by one factor and "
        "leaves all other weights unchanged.",
    )
