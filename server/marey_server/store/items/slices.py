"""Some frames and joints of a stored motion, decoding no more than needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.problems import FieldError
from marey_schemas.wording import counted
from marey_server.errors import Invalid

Tree = dict[str, Any]


def slice_motion(motion: Tree, frames: slice | None, joints: Sequence[str] | None) -> Tree:
    """The motion with only these frames and joints; the root's translation stays.

    Parameters
    ----------
    motion : document of schema marey/motion@1 with `EncodedArray` leaves
    frames : half-open range, clipped to the motion
    joints : names in the order wanted
    """
    cut = dict(motion)
    poses: EncodedArray = motion["poses"]
    if frames is not None and len(range(*frames.indices(poses.shape[0]))) == 0:
        detail = f"The motion has {counted(poses.shape[0], 'frame')}; the range holds none of them."
        raise _invalid("frames", "no-frames", detail)
    names = list(motion["joints"])
    wanted = names if joints is None else list(joints)
    if unknown := [name for name in wanted if name not in names]:
        raise _invalid("joints", "no-joint", f"The motion has no joint {unknown[0]!r}.")
    if len(set(wanted)) != len(wanted) or not wanted:
        raise _invalid("joints", "bad-joints", "Name each joint once, and at least one.")
    cut["joints"] = wanted
    cut["poses"] = _decode(poses, frames, None if joints is None else _pose_columns(names, wanted))
    translated = list(motion.get("translated_joints") or ())
    if motion.get("translations") is not None:
        kept = [name for name in translated if name in wanted]
        cut["translated_joints"] = kept
        cut["translations"] = _cut_translations(motion["translations"], frames, translated, kept) if kept else None
    return cut


def _pose_columns(names: Sequence[str], wanted: Sequence[str]) -> NDArray[np.intp]:
    index = {name: position for position, name in enumerate(names)}
    starts = 3 + 4 * np.array([index[name] for name in wanted], np.intp)
    return np.concatenate([np.arange(3, dtype=np.intp), (starts[:, None] + np.arange(4)).ravel()])


def _cut_translations(
    stored: EncodedArray, frames: slice | None, translated: Sequence[str], kept: Sequence[str]
) -> NDArray[Any]:
    starts = 3 * np.array([translated.index(name) for name in kept], np.intp)
    array = _decode(stored, frames, (starts[:, None] + np.arange(3)).ravel())
    return array.reshape(len(array), len(kept), 3)


def _decode(stored: EncodedArray, frames: slice | None, columns: NDArray[np.intp] | None) -> NDArray[Any]:
    return np.ascontiguousarray(blocks.decode(stored.data, frames=frames, columns=columns))


def _invalid(pointer: str, code: str, detail: str) -> Invalid:
    return Invalid(detail, code=code, errors=[FieldError(pointer=pointer, code=code, detail=detail)])
