"""Slices of a stored motion: decodes only the blocks that contain the selected frames and joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.problems import FieldError
from marey_schemas.wording import counted, listed, nearest
from marey_server.errors import InvalidProblem

Tree = dict[str, Any]


def slice_motion(motion: Tree, frames: slice | None, joints: Sequence[str] | None, *, encoded: bool = False) -> Tree:
    """Cut a motion to a range of frames and a list of joints; the translation of the root is always kept.

    Raises `InvalidProblem` if the range contains no frame, or if `joints` is empty or has an unknown or repeated name.

    Parameters
    ----------
    motion : document of schema marey/motion@1 with `EncodedArray` leaves
    frames : half-open range, clipped to the motion
    joints : names in the order of the result
    encoded : whether the arrays of the result are `EncodedArray`, too; otherwise they are numpy arrays
    """
    cut = dict(motion)
    poses: EncodedArray = motion["poses"]
    chosen = range(*(frames or slice(None)).indices(poses.shape[0]))
    if not chosen:
        detail = (
            f"The motion has {counted(poses.shape[0], 'frame')}; the range contains none of them. Write first:end, "
            "with the first frame before the end, counted from 0."
        )
        raise _invalid("frames", "no-frames", detail)
    names = list(motion["joints"])
    wanted = names if joints is None else list(joints)
    if unknown := [name for name in wanted if name not in names]:
        near = nearest(unknown[0], names)
        remedy = f"did you mean {near!r}?" if near else f"its joints are {listed(names)}."
        raise _invalid("joints", "no-joint", f"The motion has no joint {unknown[0]!r}; {remedy}")
    if len(set(wanted)) != len(wanted) or not wanted:
        raise _invalid("joints", "bad-joints", "Give at least one joint, and no joint twice.")
    cut["joints"] = wanted
    cut["poses"] = _cut(poses, chosen, None if joints is None else _pose_columns(names, wanted), encoded=encoded)
    stored: EncodedArray | None = motion.get("translations")
    if stored is not None:
        translated = list(motion["translated_joints"])
        kept = [name for name in translated if name in wanted]
        cut["translated_joints"] = kept
        columns = None if joints is None else _translation_columns(translated, kept)
        cut["translations"] = _cut(stored, chosen, columns, encoded=encoded) if kept else None
    return cut


def _pose_columns(names: Sequence[str], wanted: Sequence[str]) -> NDArray[np.intp]:
    index = {name: position for position, name in enumerate(names)}
    starts = 3 + 4 * np.array([index[name] for name in wanted], np.intp)
    return np.concatenate([np.arange(3, dtype=np.intp), (starts[:, None] + np.arange(4)).ravel()])


def _translation_columns(names: Sequence[str], wanted: Sequence[str]) -> NDArray[np.intp]:
    starts = 3 * np.array([names.index(name) for name in wanted], np.intp)
    return (starts[:, None] + np.arange(3)).ravel()


def _cut(
    stored: EncodedArray, frames: range, columns: NDArray[np.intp] | None, *, encoded: bool
) -> NDArray[Any] | EncodedArray:
    """Return some frames and columns of an array, whose first axis is the frames.

    `columns` are indices into all other axes, flattened; None means all columns.
    """
    if encoded and columns is None:
        return stored.cut_frames(frames.start, frames.stop)
    array = blocks.decode(stored.data, frames=slice(frames.start, frames.stop), columns=columns)
    array = np.ascontiguousarray(array).reshape(len(frames), -1, *stored.shape[2:])
    return EncodedArray.of(array, predict=False) if encoded else array


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, code=code, errors=[FieldError(pointer=pointer, code=code, detail=detail)])
