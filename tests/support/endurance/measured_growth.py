"""Growth of a measured quantity over time, with its confidence interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

BLOCKS = 10
HOUR_S = 3600.0


@dataclass(frozen=True)
class Growth:
    """Mean amount of memory in MB, its slope in MB per hour, and half the width of the slope's 95 % interval."""

    mean_mb: float
    slope_mb_h: float
    margin_mb_h: float

    @property
    def low_mb_h(self) -> float:
        """The lower end of the interval of the slope."""
        return self.slope_mb_h - self.margin_mb_h

    def __str__(self) -> str:
        return f"{self.mean_mb:.0f} MB, growing by {self.slope_mb_h:+.1f} ± {self.margin_mb_h:.1f} MB per hour"


def growth_of(times_s: npt.NDArray[np.float64], values_mb: npt.NDArray[np.float64]) -> Growth:
    """Return the growth of samples: the line through the means of ten blocks of neighbouring samples.

    Neighbouring samples are alike, so that single samples would give an interval that is too narrow. Raises
    `ValueError` if there are fewer samples than blocks.
    """
    if len(times_s) < BLOCKS:
        raise ValueError(f"{len(times_s)} samples are too few; {BLOCKS} are needed, so run the trial for longer")
    hours = np.array([block.mean() for block in np.array_split(times_s, BLOCKS)]) / HOUR_S
    means = np.array([block.mean() for block in np.array_split(values_mb, BLOCKS)])
    line = stats.linregress(hours, means)
    margin = float(stats.t.ppf(0.975, BLOCKS - 2) * line.stderr)
    return Growth(float(values_mb.mean()), float(line.slope), margin)
