"""Options that determine what the numbers of a job of the kind `quality` mean."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Options
from marey_schemas.options.contacts import TOE_SPEED_M_S

QUALITY_RATE_HZ = 30.0
"""Frame rate at which clips are measured; the rates of common recordings are multiples of it."""

_Height = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
_Speed = Annotated[float, Field(gt=0, le=20, allow_inf_nan=False)]
_Bend = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]


class QualityOptions(Options):
    """Frame rate, floor and limits of the measures of motion quality.

    The defaults are those of the publications that `marey_schemas.documents.quality.MEASURES` names.
    """

    rate_hz: float = Field(
        QUALITY_RATE_HZ,
        ge=5,
        le=1000,
        allow_inf_nan=False,
        description="Frame rate in hertz at which clips are measured. Clips of a higher rate are resampled; clips of a "
        "lower rate are refused.",
    )
    floor: Literal["planted", "zero"] = Field(
        "planted",
        description="Reference from which the heights of feet are measured. planted: the height of the joint "
        "while the foot stands on the floor, which is the 5th percentile of the heights of the joint "
        "in the clip; zero: height 0, as in the publications of the measures. Penetration is always "
        "measured from height 0.",
    )
    weighted_height_m: _Height = Field(
        0.025,
        description="Height in metres from which the speed of a toe does not count in the measure "
        "`skate_weighted_m_s`; below, its weight grows from 0 to 1 at the floor.",
    )
    near_height_m: _Height = Field(
        0.05,
        description="Height in metres below which a toe counts as near the floor, in the measures "
        "`skate_height_m_s` and `skate_ratio`.",
    )
    skate_speed_m_s: _Speed = Field(
        0.2,
        description="Speed in metres per second above which a toe near the floor counts as skating, in the "
        "measure `skate_ratio`.",
    )
    contact_height_m: _Height = Field(
        0.1,
        description="Height in metres below which a slow joint counts as touching the floor, in the measure "
        "`contact_consistency`.",
    )
    contact_speed_m_s: _Speed = Field(
        TOE_SPEED_M_S,
        description="Speed in metres per second below which a low joint counts as touching the floor, in the "
        "measure `contact_consistency`.",
    )
    knee_least_deg: _Bend = Field(
        -10.0,
        description="Smallest bend of a knee in its natural range, in degrees; negative: overextended. Smaller bends "
        "count in the measures `limit_excess_deg` and `limit_excess_max_deg`.",
    )
    knee_most_deg: _Bend = Field(
        135.0,
        description="Greatest bend of a knee in its natural range, in degrees. Greater bends count in the measures "
        "`limit_excess_deg` and `limit_excess_max_deg`.",
    )
    elbow_most_deg: _Bend = Field(
        150.0,
        description="Greatest bend of an elbow in its natural range, in degrees. Greater bends count in the measures "
        "`limit_excess_deg` and `limit_excess_max_deg`.",
    )

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.knee_least_deg >= self.knee_most_deg:
            raise ValueError("knee_least_deg must be less than knee_most_deg")
        return self
