"""Names of the array types that the library takes and returns.

Shapes, units and frames of reference are given where the arrays are used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating[Any]]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
AnyInts = NDArray[np.integer]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

CM_PER_M = 100.0
