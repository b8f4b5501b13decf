"""Defects of suggested clips beside those of the set: a clip with a defect can fill a gap in the coverage, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

COMPARED: Mapping[str, float] = MappingProxyType(
    {"skate_weighted_m_s": 0.05, "penetration_max_m": 0.02, "jerk_peak_m_s3": 500.0, "limit_excess_max_deg": 5.0}
)
"""Measures that are compared, one for each sort of defect, by their names in `MEASURES`; less is better in all.

The value is the least difference, in the unit of the measure, that counts: below, nobody would look at a clip twice.
"""
FACTOR = 2.0
"""Times the greatest value in the set that a suggested clip must exceed.

Clips that fill gaps move faster or turn more than those of the set, so some of their measures are greater without any
defect. Decision 0095 has the measured shares of false alarms and of found defects.
"""


@dataclass(frozen=True)
class Excess:
    """Measure of a suggested clip that is far greater than `greatest`, the greatest value in the set.

    Both values are in the unit of the measure.
    """

    measure: str
    value: float
    greatest: float


@dataclass(frozen=True)
class Defects:
    """Measures of the quality of a suggested clip, compared with those of the clips of the set.

    Parameters
    ----------
    values : value of each measure of `MEASURES`, None where it is undefined; empty if the clip could not be measured
    excesses : compared measures that are far greater than in all clips of the set
    compared : number of clips of the set that were measured
    problem : reason why the clip could not be measured; None if it was
    """

    values: Mapping[str, float | None]
    excesses: tuple[Excess, ...] = ()
    compared: int = 0
    problem: str | None = None


def compare_defects(values: Mapping[str, float | None], of_set: Sequence[Mapping[str, float | None]]) -> Defects:
    """Find the measures in which a suggested clip is far worse than all clips of the set.

    A measure counts if it is more than `FACTOR` times the greatest value in the set, and also greater than this value
    by more than the difference in `COMPARED`.

    Parameters
    ----------
    values : mapping of str to float or None    value of each measure of the suggested clip
    of_set : sequence of mappings    the same measures of each clip of the set

    Returns
    -------
    Defects    the values, and the measures that count. A measure that is undefined for the clip, or for all clips of
        the set, does not count.
    """
    found = []
    for name, least in COMPARED.items():
        value, others = values[name], [one for each in of_set if (one := each[name]) is not None]
        if value is not None and others and value > max(FACTOR * max(others), max(others) + least):
            found.append(Excess(name, value, max(others)))
    return Defects(values, tuple(found), len(of_set))
