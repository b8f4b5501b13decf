"""Limit of the memory that the motion of a small file may need."""

from __future__ import annotations

from marey_motion.errors import FormatLimit
from marey_schemas.formats import MOST_UNPACKED_BYTES

_ROTATION_NUMBERS, _ROTATION_BYTES = 4, 16
# In real files, most joints have channels: about three numbers in the file give the four numbers of a rotation.
_MOST_PER_NUMBER = 8


def require_unpackable(frames: int, joints: int, numbers: int, file: str) -> None:
    """Refuse a motion that needs much more memory than the numbers of its file.

    Joints without channels need no space in a file, but have a rotation in each frame.

    Parameters
    ----------
    frames, joints : int    size of the motion
    numbers : int    count of the numbers in the file that describe it
    file : str    name of the file, for messages

    Raises
    ------
    FormatLimit    if the rotations need more than `MOST_UNPACKED_BYTES`, and most of them are not in the file
    """
    rotations = frames * joints
    if rotations * _ROTATION_BYTES > MOST_UNPACKED_BYTES and rotations * _ROTATION_NUMBERS > _MOST_PER_NUMBER * numbers:
        raise FormatLimit(
            f"the motion of {joints} joints over {frames:,} frames needs {rotations * _ROTATION_BYTES:,} bytes, but "
            f"most joints have no channels; the limit is {MOST_UNPACKED_BYTES:,} bytes: remove these joints, or "
            "split the file",
            file=file,
        )
