"""The trials of an evaluation and the trajectories they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Family = Literal["circle", "switching"]


@dataclass(frozen=True)
class Trial:
    """One trajectory to follow: straight for `approach_s`, then a circle, or a chain of arcs whose speed switches.

    Speeds in m/s; `turn_rate_rad_s` positive to the left. `switch_speed_m_s` and `switch_every_s` count for the
    switching family only, whose clock starts with the circle.
    """

    family: Family
    speed_m_s: float
    turn_rate_rad_s: float
    approach_s: float = 3.0
    duration_s: float = 30.0
    switch_speed_m_s: float = 4.0
    switch_every_s: float = 5.0

    @property
    def name(self) -> str:
        """For example "circle v=1.25 w=-50": stable, and unique within a suite."""
        return f"{self.family} v={self.speed_m_s:g} w={np.degrees(self.turn_rate_rad_s):g}"


@dataclass(frozen=True, eq=False)
class Reference:
    """A trial's trajectory, sampled at every tick and `look_ahead` ticks beyond its end.

    Parameters
    ----------
    tick_count : T, ticks of the trial itself; the arrays have T + look_ahead rows
    positions : (T + L, 2) float64    metres on the ground
    headings, speeds_m_s, turn_rates_rad_s : (T + L,) float64
    """

    rate_hz: float
    tick_count: int
    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    speeds_m_s: NDArray[np.float64]
    turn_rates_rad_s: NDArray[np.float64]
