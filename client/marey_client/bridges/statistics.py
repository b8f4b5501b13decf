"""Statistics of columns of numbers, computed episode by episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class ColumnStatistics:
    """Number of rows, and the extremes, the mean and the summed squared deviations of each column, all as float64."""

    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]

    @classmethod
    def of(cls, rows: NDArray[np.generic]) -> Self:
        """Return the statistics of (rows, columns) numbers; an array with one dimension is one column."""
        values = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1)
        mean = values.mean(axis=0)
        squares = np.square(values - mean).sum(axis=0)
        return cls(len(values), values.min(axis=0), values.max(axis=0), mean, squares)

    def merged(self, other: ColumnStatistics) -> ColumnStatistics:
        """Return the statistics of the rows of both, after Chan, Golub and LeVeque (1979)."""
        count = self.count + other.count
        shift = other.mean - self.mean
        return ColumnStatistics(
            count,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
            self.mean + shift * (other.count / count),
            self.squares + other.squares + np.square(shift) * (self.count * other.count / count),
        )

    @property
    def document(self) -> dict[str, list[float] | list[int]]:
        """The statistics in the form of LeRobot; `std` is that of the whole, not of a sample."""
        return {
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.squares / self.count).tolist(),
            "count": [self.count],
        }
