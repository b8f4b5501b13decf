"""Skeleton models of Marey's predecessor: standard joints, and anatomical axes of joints.

A document is `{"joints": {standard joint: joint or null}, "cos_map": {joint: {"x": swing or null, "y": twist or null}},
...}`, often inside `{"name", "model"}`. The names of the standard joints are the same as in Marey. An axis is a
direction in the joint's local frame, as in Marey. Other members, such as joint limits and foot shapes, have no
counterpart in Marey; they are stored unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError
from marey_motion.formats.document_fields import field_of, number_array
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.standard_joints import STANDARD_JOINTS

JOINTS, AXES = "joints", "cos_map"


@dataclass(frozen=True)
class PredecessorSkeletonModel:
    """A skeleton model of Marey's predecessor: standard joints of a skeleton, and anatomical axes of its joints.

    Parameters
    ----------
    joints : joint of the skeleton by standard joint
    swings, twists : swing and twist axes of joints, each (3,), of unit length, in the joint's local frame
    rest : other members of the document
    """

    joints: Mapping[str, str]
    swings: Mapping[str, Floats] = field(default_factory=dict)
    twists: Mapping[str, Floats] = field(default_factory=dict)
    rest: Mapping[str, Any] = field(default_factory=dict)


def is_skeleton_model(document: Mapping[str, Any]) -> bool:
    """Check whether a document is a skeleton model, alone or inside `{"name", "model"}`.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    bool    True for a skeleton model
    """
    inner = _inner(document)
    return isinstance(inner.get(JOINTS), Mapping) and not {"root", "jointDescs", "sspm"} & inner.keys()


def skeleton_model_of_document(document: Mapping[str, Any], skeleton: Skeleton, file: str) -> PredecessorSkeletonModel:
    """Read a skeleton model from a decoded document of Marey's predecessor.

    Parameters
    ----------
    document : mapping    the document
    skeleton : Skeleton    skeleton that it describes
    file : str    name of the file, for messages

    Returns
    -------
    PredecessorSkeletonModel    the model

    Raises
    ------
    FormatError    if the document names a joint that does not exist, or an axis is not a direction
    """
    inner = _inner(document)
    joints: dict[str, str] = {}
    for standard, joint in field_of(inner, JOINTS, dict, file).items():
        if standard not in STANDARD_JOINTS:
            raise FormatError(f"field {JOINTS!r}: {standard!r} is not a standard joint", file=file)
        if joint is not None:
            joints[standard] = _known(joint, skeleton, JOINTS, file)
    found = PredecessorSkeletonModel(joints, rest={k: v for k, v in inner.items() if k not in (JOINTS, AXES)})
    swings: dict[str, Floats] = {}
    twists: dict[str, Floats] = {}
    for joint, axes in (field_of(inner, AXES, dict, file) if inner.get(AXES) is not None else {}).items():
        _known(joint, skeleton, AXES, file)
        for name, directions in (("x", swings), ("y", twists)):
            if field_of({"axes": axes}, "axes", dict, file).get(name) is not None:
                directions[joint] = _direction(axes[name], joint, name, file)
    return replace(found, swings=swings, twists=twists)


def skeleton_model_document(model: PredecessorSkeletonModel) -> dict[str, Any]:
    """Convert a skeleton model to its document.

    Parameters
    ----------
    model : PredecessorSkeletonModel    the model

    Returns
    -------
    dict    the document; standard joints that the skeleton does not have are null
    """
    axes = {
        joint: {
            name: None if joint not in given else given[joint].tolist()
            for name, given in (("x", model.swings), ("y", model.twists))
        }
        for joint in {**model.twists, **model.swings}
    }
    return {**model.rest, JOINTS: {name: model.joints.get(name) for name in STANDARD_JOINTS}, AXES: axes}


def across(swing: Floats | None, twist: Floats) -> Floats:
    """Make a swing axis perpendicular to a twist axis.

    Parameters
    ----------
    swing : (3,) float64, optional    direction to start from
    twist : (3,) float64    the twist axis, of unit length

    Returns
    -------
    (3,) float64    unit length; any perpendicular direction if `swing` is absent or parallel to `twist`
    """
    for start in ([] if swing is None else [swing]) + [np.eye(3)[np.argmin(np.abs(twist))]]:
        direction = start - (start @ twist) * twist
        if np.linalg.norm(direction) > 1e-6:
            return np.asarray(direction / np.linalg.norm(direction))
    raise AssertionError(f"the twist axis must have finite coordinates, not {twist}")


def _inner(document: Mapping[str, Any]) -> Mapping[str, Any]:
    inner = document.get("model")
    return inner if isinstance(inner, Mapping) else document


def _known(joint: Any, skeleton: Skeleton, name: str, file: str) -> str:
    if not isinstance(joint, str) or joint not in skeleton:
        raise FormatError(
            f"field {name!r} of the skeleton model names a joint that the skeleton does not have; import the skeleton "
            "model with the skeleton for which it was made",
            code="joints-mismatch",
            file=file,
            joint=str(joint),
        )
    return joint


def _direction(values: Any, joint: str, name: str, file: str) -> Floats:
    axis = number_array(values, file, f"{AXES}: {name}", joint)
    length = np.linalg.norm(axis)
    if axis.shape != (3,) or not length > 1e-9:
        raise FormatError(
            f"field {AXES!r}: the axis {name!r} must be three numbers that are not all zero", file=file, joint=joint
        )
    return np.asarray(axis / length)
