"""The unit of length and the upward axis of a file, inferred from the body, with the evidence.

Files rarely state the unit or the axis. Both can be inferred from the body: an adult's leg is about 0.9 m long, the
head is above the feet, and feet on the ground stay at one height. Every finding is stored as a sentence with its
numbers; if the findings are not conclusive, an error asks the user.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import AmbiguousUnits, MotionError
from marey_motion.importing.anatomy import Anatomy
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.landmarks import Landmarks
from marey_motion.importing.order_statistics import low_quantile, median
from marey_motion.importing.source import SourceMotion
from marey_motion.kinematics import forward_kinematics
from marey_schemas.formats import UNITS_M
from marey_schemas.options.imports import Handedness, ImportOptions, UpAxis

CONVENTIONAL_UNITS = ("m", "cm", "mm")
# Adults, from the joint that carries both legs down the bones to the ankle. No length fits two units in these bounds.
LEG_LENGTH_M = (0.72, 1.2)
# Bodies of any kind, such as children and animals.
ANY_LEG_LENGTH_M = (0.1, 1.5)

_SAMPLED_FRAMES = 64
_CLEAR_COSINE = 0.8
_MIRRORED_COSINE = -0.2
# Legs and trunk that point the same way: no pose of a body, but bones all put on one line.
_FOLDED_COSINE = -0.9
_FOLDED = "rest pose that is none of a body, with legs and trunk pointing the same way"
_FLAT_GROUND = 0.1
_CLEARLY_FLATTER = 3.0


def unit_in_metres(unit: str | float) -> float:
    """Convert a unit of length to metres.

    Parameters
    ----------
    unit : str or float    name (`UNITS_M`) or size in metres

    Returns
    -------
    float    metres

    Raises
    ------
    MotionError    for an unknown name or a size that is not positive
    """
    metres = UNITS_M.get(unit.lower()) if isinstance(unit, str) else float(unit)
    if metres is None or not (np.isfinite(metres) and metres > 0):
        raise MotionError(
            f"the unit {unit!r} is unknown; give one of {', '.join(UNITS_M)}, or its length in metres, above 0",
            code="unit-unknown",
        )
    return metres


@dataclass(frozen=True)
class Conversion:
    """Conversion of a file's lengths and axes to metres with Y up, with the evidence."""

    unit_scale_m: float
    up_axis: UpAxis
    handedness: Handedness
    evidence: tuple[str, ...]
    warnings: tuple[CheckWarning, ...]


@dataclass
class _Measurements:
    """Measures of the body in a file, in the unit and axes of the file.

    `positions` (J, F, 3) are joint positions in sampled frames, `rest` (J, 3) joint positions in the rest pose. `leg`
    is None if there are not two feet.
    """

    file: str
    landmarks: Landmarks
    positions: NDArray[np.float64]
    rest: NDArray[np.float64]
    leg: float | None
    evidence: list[str] = field(default_factory=list)
    warnings: list[CheckWarning] = field(default_factory=list)


def infer_conversion(source: SourceMotion, anatomy: Anatomy, file: str, options: ImportOptions) -> Conversion:
    """Determine the unit and the upward axis from the options, or else from the format, or else from the body.

    Parameters
    ----------
    source : SourceMotion    the file in its own unit and axes
    anatomy : Anatomy    anatomy of the source's skeleton
    file : str    name of the file, for messages
    options : ImportOptions    facts given by the user

    Returns
    -------
    Conversion    unit, axes and evidence

    Raises
    ------
    AmbiguousUnits    naming the option to set and the candidates, when the body does not decide
    """
    body = _measure(source, anatomy, file)
    up_axis = _choose_up_axis(source, body, options)
    unit_scale_m = _choose_unit(source, body, options, up_axis)
    _look_for_mirroring(source, body, options, up_axis)
    return Conversion(unit_scale_m, up_axis, options.handedness, tuple(body.evidence), tuple(body.warnings))


def _measure(source: SourceMotion, anatomy: Anatomy, file: str) -> _Measurements:
    skeleton, landmarks = anatomy.skeleton, anatomy.landmarks
    rest = skeleton.rest_global_positions
    positions: NDArray[np.floating[Any]] = rest[None]
    if source.rotations is not None and source.root_positions is not None:
        frames = _sampled_frames(len(source.rotations))
        poses = np.empty((len(frames), 3 + 4 * skeleton.joint_count))
        poses[:, :3] = source.root_positions[frames]
        poses[:, 3:] = source.rotations[frames].reshape(len(frames), -1)
        translations = None if source.translations is None else source.translations[frames]
        positions = forward_kinematics(
            skeleton,
            poses,
            translations=translations,
            translated_joints=source.translated_joints,
        )
    of_joints = np.ascontiguousarray(positions.transpose(1, 0, 2), np.float64)
    return _Measurements(file, landmarks, of_joints, rest, anatomy.leg)


@lru_cache(maxsize=256)
def _sampled_frames(count: int) -> NDArray[np.int64]:
    """Choose at most 64 different frames of a motion of `count` frames, evenly spaced."""
    spaced = np.linspace(0, count - 1, _SAMPLED_FRAMES).astype(np.int64)
    frames: NDArray[np.int64] = spaced[np.concatenate(([True], spaced[1:] > spaced[:-1]))]
    frames.setflags(write=False)
    return frames


# Up axis


def _choose_up_axis(source: SourceMotion, body: _Measurements, options: ImportOptions) -> UpAxis:
    if options.up_axis is not None:
        body.evidence.append(f"up axis {options.up_axis}: given by the user")
        return options.up_axis
    if source.up_axis is not None:
        body.evidence.append(f"up axis {source.up_axis}: fixed by the format")
        return source.up_axis
    if body.leg is None:
        body.evidence.append("up axis y: the usual one, assumed because no feet were found")
        body.warnings.append(
            CheckWarning("up-axis-assumed", "no feet were found that show which axis points up; y is assumed")
        )
        return "y"
    standing, flat = _body_axis(body.positions, body.landmarks), _flat_axis(body)
    if flat is not None and flat[0] != standing[0] and _stands_on_all_fours(body, flat[0]):
        body.evidence.append(f"up axis {flat[0]}: hands and feet are below the hips; {flat[1]}")
        return flat[0]
    if standing[0] == "y" and standing[1] >= _CLEAR_COSINE:
        body.evidence.append(
            f"up axis y: head above feet, mean cosine {standing[1]:.2f} over {body.positions.shape[1]} frames"
        )
        return "y"
    return _settle_up_axis(body, *standing, flat)


def _settle_up_axis(body: _Measurements, axis: UpAxis, cosine: float, flat: tuple[UpAxis, str] | None) -> UpAxis:
    """Choose the upward axis if the body is not upright along y.

    The body may lie or climb, or another axis may point up.

    `axis` is the axis nearest to the direction from feet to head, and `cosine` is the cosine of the angle between this
    axis and the direction. `flat` is the result of `_flat_axis`.
    """
    rest_axis, rest_cosine = _body_axis(body.rest[:, None], body.landmarks)
    standing, resting = f"mean direction from feet to head is {axis} with cosine {cosine:.2f}", _FOLDED
    if rest_cosine > 0.0:
        resting = f"rest pose points along {rest_axis} with cosine {rest_cosine:.2f}"
    if cosine == 0.0:
        standing = f"the motion keeps to a {_FOLDED}"
    if cosine >= _CLEAR_COSINE and rest_axis == axis and rest_cosine >= _CLEAR_COSINE:
        body.evidence.append(f"up axis {axis}: {standing}; {resting}")
        return axis
    if flat is not None:
        body.evidence.append(f"up axis {flat[0]}: {flat[1]}; {standing}")
        return flat[0]
    if cosine >= _CLEAR_COSINE:
        grounded = [candidate for candidate in (axis, rest_axis) if _stands_on_origin(body, candidate)]
        if len(set(grounded)) == 1:
            body.evidence.append(
                f"up axis {grounded[0]}: the ground through the origin bears the body; {standing}; {resting}"
            )
            return grounded[0]
    raise AmbiguousUnits(
        f"the file does not show clearly which axis points up ({standing}; {resting}); name the axis with "
        f"--up-axis (up_axis), one of {_likely_axes((axis, cosine), (rest_axis, rest_cosine))}",
        code="up-axis-ambiguous",
        file=body.file,
    )


def _likely_axes(*axes: tuple[UpAxis, float]) -> str:
    """List in words the axes for which there is evidence, or the usual axes if there is no evidence."""
    likely = list(dict.fromkeys(axis for axis, cosine in axes if cosine > 0.0))
    return " or ".join(likely if len(likely) > 1 else dict.fromkeys((*likely, "y", "z")))


def _body_axis(positions: NDArray[np.float64], landmarks: Landmarks) -> tuple[UpAxis, float]:
    """Find the signed coordinate axis nearest to the mean direction from the feet to the head (or hips).

    Also returns the cosine of the angle between this axis and the direction. The cosine is 0 if legs and trunk are
    folded onto each other, as in a rest pose with all bones on one line.
    """
    assert landmarks.feet is not None
    assert landmarks.hips is not None
    feet, hips = _mean_point(positions, landmarks.feet), positions[landmarks.hips]
    if landmarks.head is None:
        (mean,), folded = _mean_directions((hips - feet)[None]), False
    else:
        head = positions[landmarks.head]
        mean, trunk, legs = _mean_directions(np.stack((head - feet, head - hips, hips - feet)))
        folded = float(trunk @ legs) < _FOLDED_COSINE
    axis = int(np.argmax(np.abs(mean)))
    return _axis_name(axis, mean[axis]), 0.0 if folded else float(abs(mean[axis]))


def _mean_directions(ways: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the mean direction (k, 3) of vectors (k, F, 3); vectors of length zero are ignored."""
    lengths = _lengths(ways)
    lengths[lengths == 0] = 1.0
    mean: NDArray[np.float64] = np.add.reduce(ways / lengths[..., None], axis=1) / ways.shape[1]
    return mean


# Below, numpy's ufuncs give the same bits as its `mean`, `std` and `norm`, which take longer than 64 poses do.


def _mean_point(positions: NDArray[np.float64], joints: Sequence[int]) -> NDArray[np.float64]:
    """Compute the mean positions (F, 3) of `joints`, whose positions are rows of `positions` (J, F, 3)."""
    mean: NDArray[np.float64] = np.add.reduce(positions.take(joints, axis=0), axis=0) / len(joints)
    return mean


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the lengths (...) of vectors (..., 3)."""
    lengths: NDArray[np.float64] = np.sqrt(np.add.reduce(vectors * vectors, axis=-1))
    return lengths


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the standard deviation (k,) over the first axis of (F, k)."""
    deviations = values - np.add.reduce(values, axis=0) / len(values)
    spread: NDArray[np.float64] = np.sqrt(np.add.reduce(deviations * deviations, axis=0) / len(values))
    return spread


def _flat_axis(body: _Measurements) -> tuple[UpAxis, str] | None:
    """Find the axis along which the lowest point of feet and hands hardly moves.

    Along the other axes, this point must move.

    Returns the axis, and the evidence for it in words; returns None if there is no such axis.
    """
    limbs = [*body.landmarks.ground_joints, *(body.landmarks.hands or ())]
    assert body.leg is not None
    below = body.positions.take(limbs, axis=0)
    middle = np.add.reduce(body.positions, axis=0) / len(body.positions)
    signs = np.where(median(middle - np.add.reduce(below, axis=0) / len(limbs)) >= 0, 1.0, -1.0)
    spread = _spread(np.minimum.reduce(below * signs, axis=0)) / body.leg
    flattest, second = np.argsort(spread)[:2]
    if spread[flattest] > _FLAT_GROUND or spread[second] < max(_CLEARLY_FLATTER * spread[flattest], _FLAT_GROUND):
        return None
    name = _axis_name(int(flattest), signs[flattest])
    x, y, z = spread
    return name, f"heights of the lowest limb spread by {x:.2f}, {y:.2f}, {z:.2f} leg lengths along x, y, z"


def _stands_on_origin(body: _Measurements, axis: UpAxis) -> bool:
    """Return whether the body stands on the plane through the origin that is perpendicular to `axis`."""
    assert body.leg is not None
    lowest = _heights(body.positions, axis).min(axis=0)
    return bool(abs(low_quantile(lowest)) <= _FLAT_GROUND * body.leg)


def _axis_name(axis: int, sign: float) -> UpAxis:
    names: tuple[UpAxis, ...] = ("x", "y", "z") if sign >= 0 else ("-x", "-y", "-z")
    return names[axis]


def _heights(positions: NDArray[np.float64], up_axis: UpAxis) -> NDArray[np.float64]:
    heights: NDArray[np.float64] = positions[..., "xyz".index(up_axis[-1])]
    return -heights if up_axis[0] == "-" else heights


# Unit


def _choose_unit(source: SourceMotion, body: _Measurements, options: ImportOptions, up_axis: UpAxis) -> float:
    hip_height = _hip_height(body, up_axis)
    if (given := options.metres_per_unit) is not None:
        body.evidence.append(f"unit {given:g} m: given by the user{_as_hips(hip_height, given)}")
        return given
    if (stated := source.unit_scale_m) is not None:
        legs_m = body.leg * stated if source.declared and body.leg is not None else None
        if legs_m is None or _within(ANY_LEG_LENGTH_M, legs_m):
            why = "; ".join(source.declared) or "fixed by the format"
            body.evidence.append(f"unit {stated:g} m: {why}{_as_hips(hip_height, stated)}")
            if legs_m is not None and not _within(LEG_LENGTH_M, legs_m):
                body.warnings.append(_doubtful_unit(stated, legs_m))
            return stated
    if body.leg is None:
        raise AmbiguousUnits(
            "the unit of length is not clear, because no two legs were found whose length could be measured; "
            "name the unit with --unit (unit_scale_m), such as cm",
            file=body.file,
        )
    return _unit_of_leg(body, hip_height, up_axis, stated)


def _doubtful_unit(stated: float, legs_m: float) -> CheckWarning:
    low, high = LEG_LENGTH_M
    return CheckWarning(
        "unit-doubtful",
        f"with the unit that the file states ({stated:.5g} m), the legs are {legs_m:.2f} m long (adults have {low} to "
        f"{high} m); if the body is an adult's, name the right unit with --unit (unit_scale_m)",
        values={"unit_scale_m": stated, "leg_length_m": legs_m},
    )


def _unit_of_leg(body: _Measurements, hip_height: float, up_axis: UpAxis, stated: float | None) -> float:
    assert body.leg is not None
    (low, high), known, reason = LEG_LENGTH_M, tuple(UNITS_M), "legs"
    if _walks_on_hands(body, up_axis):
        (low, high), known, reason = ANY_LEG_LENGTH_M, CONVENTIONAL_UNITS, "hands stay on the ground, and legs"
    elif not body.landmarks.by_names:
        known, reason = CONVENTIONAL_UNITS, "the build is a body's, and legs"
    fitting = [name for name in known if _within((low, high), body.leg * UNITS_M[name])]
    if len(fitting) != 1:
        raise _ambiguous_unit(body, hip_height)
    scale = UNITS_M[fitting[0]]
    measured = f"{reason} of {body.leg:.4g} units are {body.leg * scale:.2f} m{_as_hips(hip_height, scale)}"
    body.evidence.append(f"unit {fitting[0]} ({scale:.5g} m): {measured}")
    if stated is not None or fitting[0] not in CONVENTIONAL_UNITS or reason != "legs":
        fault = "does not state its unit of length" if stated is None else f"states an impossible unit ({stated:.5g} m)"
        body.warnings.append(
            CheckWarning(
                "unit-inferred",
                f"the file {fault}; {fitting[0]} is assumed, because {measured}",
                values={"unit_scale_m": scale, "leg_length_m": body.leg * scale, "hip_height_m": hip_height * scale},
            )
        )
    return scale


def _ambiguous_unit(body: _Measurements, hip_height: float) -> AmbiguousUnits:
    assert body.leg is not None
    by_fit = sorted(UNITS_M, key=lambda name: abs(np.log((body.leg or 1.0) * UNITS_M[name] / 0.9)))
    listed = [
        f"{name} (legs {body.leg * UNITS_M[name]:.2f} m, hips {hip_height * UNITS_M[name]:.2f} m)"
        for name in by_fit[:3]
    ]
    low, high = LEG_LENGTH_M
    return AmbiguousUnits(
        f"the unit of length is not clear: legs of {body.leg:.4g} units fit no known unit "
        f"(adults have {low} to {high} m); "
        f"name it with --unit (unit_scale_m); candidates: {', '.join(listed)}",
        file=body.file,
    )


def _within(bounds: tuple[float, float], value: float) -> bool:
    return bounds[0] <= value <= bounds[1]


def _hip_height(body: _Measurements, up_axis: UpAxis) -> float:
    """Compute the median height of the hips above the ground, in the file's unit; 0 if the body has no feet."""
    if body.leg is None:
        return 0.0
    return float(median(hip_heights(body.positions.transpose(1, 0, 2), body.landmarks, up_axis)))


def hip_heights(positions: NDArray[np.float64], landmarks: Landmarks, up_axis: UpAxis = "y") -> NDArray[np.float64]:
    """Measure the heights of the hips above the lowest positions of feet or toes.

    Parameters
    ----------
    positions : (F, J, 3) float64    in any unit
    landmarks : Landmarks    joints of the body
    up_axis : str    the axis that points up

    Returns
    -------
    (F,) float64    in the unit of `positions`
    """
    above = _heights(positions, up_axis)
    ground = low_quantile(np.minimum.reduce(above.take(landmarks.ground_joints, axis=1), axis=1))
    heights: NDArray[np.float64] = above[:, landmarks.hips] - ground
    return heights


def _as_hips(hip_height: float, scale: float) -> str:
    return f", hips {hip_height * scale:.2f} m above the ground" if hip_height > 0 else ""


def _walks_on_hands(body: _Measurements, up_axis: UpAxis) -> bool:
    if body.landmarks.hands is None or body.leg is None:
        return False
    heights = _heights(body.positions, up_axis)
    hands = np.minimum.reduce(heights.take(body.landmarks.hands, axis=0), axis=0)
    feet = np.minimum.reduce(heights.take(body.landmarks.ground_joints, axis=0), axis=0)
    return bool(median(hands - feet) < 0.25 * body.leg)


def _stands_on_all_fours(body: _Measurements, up_axis: UpAxis) -> bool:
    """Return whether hands and feet are on one ground well below the hips; not if the body lies on its side."""
    assert body.leg is not None
    return _walks_on_hands(body, up_axis) and _hip_height(body, up_axis) > 0.5 * body.leg


# Handedness


def _look_for_mirroring(source: SourceMotion, body: _Measurements, options: ImportOptions, up_axis: UpAxis) -> None:
    """Warn if left and right seem exchanged.

    The body is assumed to face where its feet point. Left and right seem exchanged if the left leg is on the right.
    """
    landmarks = body.landmarks
    if landmarks.feet is None or landmarks.toes is None or options.handedness == "left":
        return
    up = np.zeros(3)
    up["xyz".index(up_axis[-1])] = -1.0 if up_axis[0] == "-" else 1.0
    left, right = (_mean_point(body.positions, _leg_joints(source.parents, landmarks, foot)) for foot in landmarks.feet)
    leftwards = left - right
    # The lower foot stands; the other may point anywhere.
    feet, toes = (body.positions.take(pair, axis=0) for pair in (landmarks.feet, landmarks.toes))
    standing = _heights(feet, up_axis).argmin(axis=0)
    x, y, z = (toes - feet)[standing, np.arange(len(standing))].T
    expected = np.empty_like(leftwards)
    expected[:, 0], expected[:, 1], expected[:, 2] = up[1] * z - up[2] * y, up[2] * x - up[0] * z, up[0] * y - up[1] * x
    scale = float(np.add.reduce(_lengths(expected) * _lengths(leftwards)))
    cosine = float(np.add.reduce(expected * leftwards, axis=None)) / scale if scale > 0 else 0.0
    if cosine < _MIRRORED_COSINE:
        body.warnings.append(
            CheckWarning(
                "left-handed",
                f"the left side of the body is on its right (mean cosine {cosine:.2f}): the file may be left-handed; "
                "if so, import it with the option handedness=left",
                values={"cosine": cosine},
            )
        )


def _leg_joints(parents: NDArray[np.int32], landmarks: Landmarks, foot: int) -> list[int]:
    """List the joints from a foot up to the hips, without the hips."""
    joints = [foot]
    while int(parents[joints[-1]]) != landmarks.hips:
        joints.append(int(parents[joints[-1]]))
    return joints
