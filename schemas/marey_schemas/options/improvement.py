"""Options of what improves a set of clips: suggestions, optimisations, sweeps of weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marey_schemas.base import Request

Price = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class ObjectiveParams(Request):
    """What a set of clips costs, in metres: the less the better."""

    offset: Price = Field(1.0, description="Weight of the mean distance from where the character should be.")
    abs_se_v: Price = Field(0.5, description="Metres that an error of 1 m/s counts as.")
    abs_se_omega_deg: Price = Field(0.005, description="Metres that an error of 1 degree/s counts as.")
    pose_cost: Price = Field(0.5, description="Metres that a metre of pose cost counts as.")
    seconds: Price = Field(0.0001, description="Metres that a second of data counts as.")
