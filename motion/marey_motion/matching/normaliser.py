"""What brings features of different units onto one scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Normaliser:
    """Offset and scale per feature dimension, frozen and named by a digest.

    Parameters
    ----------
    offset, scale : (D,) float64    `apply` gives (features - offset) / scale; weights are part of the scale
    fitted_on : digest of the data it was fitted on
    """

    offset: NDArray[np.float64]
    scale: NDArray[np.float64]
    fitted_on: str
