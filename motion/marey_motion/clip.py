"""A motion of one skeleton, sampled at a constant rate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import ClipError
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.clips import UNIT_TOLERANCE

_SURELY_UNIT = 1.9 * UNIT_TOLERANCE
"""Deviation of a squared quaternion length from 1 that the quick check accepts.

The value is a little below the limit of the full check, so that float32 rounding in the quick check does no harm.
"""


@dataclass(frozen=True, eq=False)
class Clip:
    """Poses of a skeleton over time.

    Arrays of the right type are not copied. The arrays of a clip are read-only.

    Parameters
    ----------
    skeleton : Skeleton    the joints that the poses belong to
    frame_rate_hz : float    frames per second
    poses : (F, 3 + 4·J) float32    absolute root translation in metres, which replaces the root's offset, then one
        unit local rotation (w, x, y, z) per joint in the skeleton's order
    translations : (F, k, 3) float32, optional    positions of `translated_joints` in their parents' frames, in metres;
        they replace the offsets of these joints. None if only the root is translated.
    translated_joints : tuple of int    increasing indices of the k joints with translations, never the root

    Raises
    ------
    ClipError    if a value is invalid; the error names the field, frame and joint

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import Clip, studio_skeleton
    >>> skeleton = studio_skeleton()
    >>> poses = np.zeros((60, 3 + 4 * skeleton.joint_count))
    >>> poses[:, 1] = 0.95
    >>> poses[:, 3::4] = 1.0
    >>> clip = Clip(skeleton, 30.0, poses)
    >>> clip.frame_count, clip.duration_s
    (60, 2.0)
    >>> clip.rotations.shape
    (60, 26, 4)
    """

    skeleton: Skeleton
    frame_rate_hz: float
    poses: NDArray[np.float32]
    translations: NDArray[np.float32] | None = None
    translated_joints: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        if not (np.isfinite(self.frame_rate_hz) and self.frame_rate_hz > 0):
            raise ClipError(
                f"the frame rate must be a positive number, not {self.frame_rate_hz}", where="frame_rate_hz"
            )
        set_field(self, "frame_rate_hz", float(self.frame_rate_hz))
        set_field(self, "poses", _frozen(self.poses, "poses", 2))
        width = 3 + 4 * self.skeleton.joint_count
        if self.poses.shape[1] != width:
            raise ClipError(
                f"the array has {self.poses.shape[1]} columns, but 3 + 4 × {self.skeleton.joint_count} joints = "
                f"{width} are needed",
                where="poses",
            )
        self._check_rotations()
        set_field(self, "translated_joints", tuple(int(joint) for joint in self.translated_joints))
        if self.translations is not None:
            set_field(self, "translations", _frozen(self.translations, "translations", 3))
        self._check_translations()

    def _check_rotations(self) -> None:
        if _surely_unit(self.rotations):
            return
        squares = np.einsum("fjc,fjc->fj", self.rotations, self.rotations)
        wrong = np.abs(squares - 1.0) > 2 * UNIT_TOLERANCE
        if wrong.any():
            frame, joint = (int(index) for index in np.argwhere(wrong)[0])
            raise ClipError(
                f"the rotation in frame {frame} must be a unit quaternion (w, x, y, z), but has length "
                f"{np.sqrt(squares[frame, joint]):.6g}",
                where=f"poses, joint {self.skeleton.joint_names[joint]}",
            )

    def _check_translations(self) -> None:
        joints, where = self.translated_joints, "translated_joints"
        if self.translations is None:
            if joints:
                raise ClipError(
                    "translated_joints is not empty, so translations must be an array, not None", where=where
                )
            return
        if self.translations.shape != (self.frame_count, len(joints), 3):
            needed = (self.frame_count, len(joints), 3)
            raise ClipError(f"the shape must be {needed}, not {self.translations.shape}", where="translations")
        if not joints:
            raise ClipError("translations are given, but no translated joints; give both or neither", where=where)
        in_order = all(a < b for a, b in pairwise(joints))
        if not in_order or joints[0] < 1 or joints[-1] >= self.skeleton.joint_count:
            raise ClipError(
                f"joint indices must be increasing and from 1 to {self.skeleton.joint_count - 1}, not {joints}",
                where=where,
            )

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return int(self.poses.shape[0])

    @property
    def duration_s(self) -> float:
        """Duration in seconds: the number of frames divided by the frame rate."""
        return self.frame_count / self.frame_rate_hz

    @property
    def root_translations(self) -> NDArray[np.float32]:
        """Absolute positions (F, 3) of the root in metres, a read-only view."""
        return self.poses[:, :3]

    @property
    def rotations(self) -> NDArray[np.float32]:
        """Local rotations (F, J, 4) as (w, x, y, z), a read-only view."""
        return self.poses[:, 3:].reshape(self.frame_count, -1, 4)

    def sliced(self, start: int, stop: int) -> Clip:
        """Make a clip of a range of frames, which shares memory with this clip.

        Parameters
        ----------
        start, stop : int    first frame, and the frame after the last

        Returns
        -------
        Clip    the frames [start, stop)

        Raises
        ------
        ClipError    unless 0 <= start < stop <= F
        """
        if not 0 <= start < stop <= self.frame_count:
            raise ClipError(
                f"the range of frames {start}:{stop} must lie within 0:{self.frame_count}, and its start must "
                "be before its stop",
                where="slice",
            )
        translations = None if self.translations is None else self.translations[start:stop]
        return replace(self, poses=self.poses[start:stop], translations=translations)


def _frozen(values: NDArray[np.generic], field: str, ndim: int) -> NDArray[np.float32]:
    """Make a read-only float32 view of `values`; the caller's array stays writable."""
    array = np.asarray(values)
    if array.ndim != ndim or array.shape[0] == 0:
        raise ClipError(f"the array must have {ndim} axes and at least one frame, not shape {array.shape}", where=field)
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise ClipError(f"the array must contain real numbers, not {array.dtype}", where=field)
    view = np.asarray(array, dtype=np.float32).view()
    if not np.isfinite(view).all():
        finite = np.isfinite(view).reshape(len(view), -1).all(axis=1)
        raise ClipError(
            f"frame {int(np.argmin(finite))} contains a number that is not finite (infinite or NaN)", where=field
        )
    view.setflags(write=False)
    return view


def _surely_unit(rotations: NDArray[np.float32]) -> bool:
    """Check quickly whether all rotations (F, J, 4) have unit length; False means that the full check must decide."""
    with np.errstate(over="ignore"):  # the check names the rotation
        squares = rotations * rotations
    lengths = squares[..., 0] + squares[..., 1]
    lengths += squares[..., 2]
    lengths += squares[..., 3]
    highest, lowest = lengths.max(initial=1.0), lengths.min(initial=1.0)
    return bool(highest - 1.0 < _SURELY_UNIT and 1.0 - lowest < _SURELY_UNIT)
