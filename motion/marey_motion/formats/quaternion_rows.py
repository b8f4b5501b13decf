"""Quaternions read from files: checked, normalised, and made continuous in sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.errors import FormatError
from marey_motion.importing.checks import CheckWarning
from marey_schemas.wording import counted

_NOTABLE_DEVIATION = 1e-3
_ROUNDING = 1e-6


def as_rotations(
    rows: NDArray[np.floating], joint_names: tuple[str, ...], file: str, warnings: list[CheckWarning]
) -> NDArray[np.float32]:
    """Normalise the quaternions of a file and warn of the changes.

    Parameters
    ----------
    rows : (F, 4 J)    quaternions (w, x, y, z) of the J joints, side by side
    joint_names : tuple of str    names of the joints, for messages
    file : str    name of the file, for messages
    warnings : list of CheckWarning    receives the warnings

    Returns
    -------
    (F, J, 4) float32    unit quaternions, continuous in sign

    Raises
    ------
    FormatError    naming the joint and the frame of a quaternion that is zero or not finite
    """
    rotations = np.empty((len(rows), len(joint_names), 4), np.float32)
    deviations: dict[str, float] = {}
    flips: dict[str, int] = {}
    for joint, name in enumerate(joint_names):  # one by one, because copies of all joints would fill memory
        values = rows[:, 4 * joint : 4 * joint + 4].astype(np.float64)
        norms = _lengths(values, name, file)
        if (deviation := float(np.abs(norms - 1.0).max(initial=0.0))) > _NOTABLE_DEVIATION:
            deviations[name] = deviation
        if flipped := int(np.count_nonzero(np.sum(values[1:] * values[:-1], axis=1) < 0)):
            flips[name] = flipped
        # Rounded unit quaternions stay as they are, to the bit.
        unit = values / np.where(np.abs(norms - 1.0) > _ROUNDING, norms, 1.0)[:, None]
        rotations[:, joint] = quaternions.unroll(unit) if flipped else unit
    _warn(deviations, flips, warnings)
    return rotations


def _lengths(values: NDArray[np.float64], joint: str, file: str) -> NDArray[np.float64]:
    """Return the lengths (F,) of a joint's quaternions (F, 4); raise `FormatError` if one is zero or not finite."""
    with np.errstate(over="ignore"):  # a length beyond all numbers is refused below
        norms: NDArray[np.float64] = np.linalg.norm(values, axis=1)
    wrong = ~(np.isfinite(norms) & (norms > 1e-6))
    if wrong.any():
        frame = int(np.argmax(wrong))
        raise FormatError(
            f"frame {frame} contains {values[frame].tolist()}, which is not a rotation; "
            "a quaternion must be finite and not zero",
            code="bad-number",
            file=file,
            joint=joint,
        )
    return norms


def _warn(deviations: dict[str, float], flips: dict[str, int], warnings: list[CheckWarning]) -> None:
    """Warn of the largest deviations from unit length, and of the numbers of changed signs, both by joint."""
    if deviations:
        worst = max(deviations.values())
        whose = f"rotations of {counted(len(deviations), 'joint')}"
        message = f"{whose} differ from unit length by up to {worst:.2g}; they were normalised"
        found = CheckWarning("non-unit-quaternions", message, joints=tuple(deviations), values={"deviation": worst})
        warnings.append(found)
    if flips:
        count = sum(flips.values())
        whose = f"rotations of {counted(len(flips), 'joint')}"
        message = f"{whose} change sign {counted(count, 'time')}; the signs were made continuous"
        warnings.append(CheckWarning("sign-flips-unrolled", message, joints=tuple(flips), values={"count": count}))
