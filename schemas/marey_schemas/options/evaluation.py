"""Options of evaluations: the trials and what is measured."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Speed = Annotated[float, Field(gt=0, le=20, allow_inf_nan=False)]
TurnRate = Annotated[float, Field(ge=-720, le=720, allow_inf_nan=False)]
DEFAULT_SPEEDS_M_S = tuple(1.0 + 0.25 * step for step in range(9))
DEFAULT_TURN_RATES_DEG_S = tuple(-100.0 + 25.0 * step for step in range(9))
