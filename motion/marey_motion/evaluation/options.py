"""Options of an evaluation: the grid of trials, their durations and the settings of the controller that is tried."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from marey_motion.matching.options import ControllerOptions, DatabaseOptions

Family = Literal["circle", "switching"]


@dataclass(frozen=True)
class Grid:
    """Speeds and turn rates of a suite; the defaults are those of the paper's section 4.2."""

    speeds_m_s: tuple[float, ...] = tuple(np.arange(1.0, 3.01, 0.25).tolist())
    turn_rates_deg_s: tuple[float, ...] = tuple(np.arange(-100.0, 100.1, 25.0).tolist())


@dataclass(frozen=True)
class EvaluationOptions:
    """Everything that decides the result beside the clips."""

    grid: Grid = field(default_factory=Grid)
    families: tuple[Family, ...] = ("circle", "switching")
    approach_s: float = 3.0
    duration_s: float = 30.0
    switch_speed_m_s: float = 4.0
    switch_every_s: float = 5.0
    window: Literal["circle", "all"] = "circle"
    coverage_least_s: float = 1.0
    literal_formulas: bool = False
    database: DatabaseOptions = field(default_factory=DatabaseOptions)
    controller: ControllerOptions = field(default_factory=ControllerOptions)
