"""Options of searches for motions of models that meet constraints."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Options


class RefineOptions(Options):
    """Refinement of what a search found, by numerical optimisation."""

    likelihood_weight: float = Field(
        1.0,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        alias="lambda",
        description="Weight of the motion's likelihood; smaller values bring the motion closer to the targets.",
    )
    iterations: int = Field(50, ge=1, le=200, description="Greatest number of iterations of the optimisation.")
