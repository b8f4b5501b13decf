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
    values: NDArray[np.floating], joint_names: tuple[str, ...], file: str, warnings: list[CheckWarning]
) -> NDArray[np.float64]:
    """Normalise the quaternions of a file and warn of the changes.

    Parameters
    ----------
    values : (F, J, 4)    quaternions (w, x, y, z)
    joint_names : tuple of str    names of the joints, for messages
    file : str    name of the file, for messages
    warnings : list of CheckWarning    receives the warnings

    Returns
    -------
    (F, J, 4) float64    unit quaternions, continuous in sign

    Raises
    ------
    FormatError    naming the joint and the frame of a quaternion that is zero or not finite
    """
    values = np.asarray(values, np.float64)
    with np.errstate(over="ignore"):  # a length beyond all numbers is refused below
        norms = np.linalg.norm(values, axis=2)
    wrong = ~(np.isfinite(norms) & (norms > 1e-6))
    if wrong.any():
        frame, joint = (int(index) for index in np.argwhere(wrong)[0])
        raise FormatError(
            f"frame {frame} contains {values[frame, joint].tolist()}, which is not a rotation; "
            "a quaternion must be finite and not zero",
            code="bad-number",
            file=file,
            joint=joint_names[joint],
        )
    deviating = (np.abs(norms - 1.0) > _NOTABLE_DEVIATION).any(axis=0)
    if deviating.any():
        names = tuple(name for name, is_one in zip(joint_names, deviating, strict=True) if is_one)
        worst = float(np.abs(norms - 1.0).max())
        whose = f"rotations of {counted(len(names), 'joint')}"
        message = f"{whose} differ from unit length by up to {worst:.2g}; they were normalised"
        warnings.append(CheckWarning("non-unit-quaternions", message, joints=names, values={"deviation": worst}))
    flips = np.sum(values[1:] * values[:-1], axis=2) < 0
    if flips.any():
        names = tuple(name for name, is_one in zip(joint_names, flips.any(axis=0), strict=True) if is_one)
        whose = f"rotations of {counted(len(names), 'joint')}"
        message = f"{whose} change sign {counted(int(flips.sum()), 'time')}; the signs were made continuous"
        warnings.append(CheckWarning("sign-flips-unrolled", message, joints=names, values={"count": int(flips.sum())}))
    # Rounded unit quaternions stay as they are, to the bit.
    unit = values / np.where(np.abs(norms - 1.0) > _ROUNDING, norms, 1.0)[..., None]
    return np.asarray(quaternions.unroll(unit), np.float64) if flips.any() else unit
