"""Median and low quantile of short arrays, bit for bit as in numpy, but with a lower cost per call."""

from __future__ import annotations

from math import floor
from typing import Any

import numpy as np

from marey_motion.arrays import AnyFloats

_LOW = 0.05


def median(values: AnyFloats) -> Any:
    """Compute the median over the first axis, as `numpy.median` does.

    Parameters
    ----------
    values : (F,) or (F, k)    at least one row; any unit

    Returns
    -------
    scalar or (k,)    in the type and unit of `values`; NaN where a value is NaN

    Examples
    --------
    >>> import numpy as np
    >>> float(median(np.array([3.0, 1.0, 2.0, 10.0])))
    2.5
    """
    ordered = np.sort(values, axis=0)
    last, middle = ordered[-1], len(ordered) // 2
    # Zero is added because it makes a negative zero positive, as the mean in numpy's median does.
    centre = ordered[middle] + 0 if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle] + 0) / 2
    undefined = np.isnan(last)
    return np.where(undefined, last, centre) if undefined.any() else centre


def low_quantile(values: AnyFloats) -> Any:
    """Compute the 5 % quantile, as `numpy.quantile` does.

    Parameters
    ----------
    values : (F,)    at least one value; any unit

    Returns
    -------
    scalar    in the type and unit of `values`; NaN if a value is NaN

    Examples
    --------
    >>> import numpy as np
    >>> float(low_quantile(np.arange(21.0)))
    1.0
    """
    place = (len(values) - 1) * _LOW
    before = floor(place)
    ordered = np.sort(values)
    if len(ordered) == 1 or np.isnan(ordered[-1]):
        return ordered[-1]
    lower, upper = ordered[before], ordered[min(before + 1, len(ordered) - 1)]
    step, share = upper - lower, place - before
    return upper - step * (1 - share) if share >= 0.5 else lower + step * share
