"""Inference of the upward axis of a file from other files of the same import that have the same skeleton."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from marey_schemas.options.imports import UpAxis


@dataclass(frozen=True)
class AxisFinding:
    """Evidence of a file about its upward axis.

    Parameters
    ----------
    skeleton : str    digest of the file's skeleton (`SourceMotion.rig_digest`)
    up_axis : str, optional    the axis that was inferred; None if the file does not show it
    is_clear : bool    true if the body stands along the axis
    """

    skeleton: str
    up_axis: UpAxis | None
    is_clear: bool


def axes_of_skeletons(findings: Iterable[AxisFinding | None]) -> dict[str, UpAxis]:
    """Collect the upward axes of skeletons from the files that show them clearly.

    Parameters
    ----------
    findings : iterable of AxisFinding or None    findings of the files of an import

    Returns
    -------
    dict of str to str    axis by digest of the skeleton; skeletons whose files contradict each other are left out
    """
    seen: dict[str, set[UpAxis]] = {}
    for finding in findings:
        if finding is not None and finding.is_clear and finding.up_axis is not None:
            seen.setdefault(finding.skeleton, set()).add(finding.up_axis)
    return {skeleton: next(iter(axes)) for skeleton, axes in seen.items() if len(axes) == 1}


def axis_of_siblings(finding: AxisFinding | None, axes: dict[str, UpAxis]) -> UpAxis | None:
    """Choose the axis with which to read a file again.

    Parameters
    ----------
    finding : AxisFinding, optional    finding of the file; None if its axis was not inferred
    axes : dict of str to str    result of `axes_of_skeletons`

    Returns
    -------
    str or None    axis of the other files with this skeleton; None if the file shows its axis clearly, if the axis of
        the other files is unknown, or if it is the axis already inferred
    """
    if finding is None or finding.is_clear:
        return None
    axis = axes.get(finding.skeleton)
    return None if axis == finding.up_axis else axis
