"""The unit of length and the upward axis of a file, inferred from the body, with the evidence.

Files rarely state the unit or the axis. Both can be inferred from the body: an adult's leg is about 0.9 m long, the
head is above the feet, and feet on the ground stay at one height. Every finding is stored as a sentence with its
numbers; if the findings are not conclusive, an error asks the user.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import AmbiguousUnits, ContradictedOption, MotionError
from marey_motion.importing.anatomy import Anatomy
from marey_motion.importing.body_measures import (
    BodyMeasures,
    heights_along,
    hip_height_of,
    lengths_of,
    mean_point,
    measure_body,
    walks_on_hands,
)
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.landmarks import Landmarks
from marey_motion.importing.source import SourceMotion
from marey_motion.importing.up_axis import choose_up_axis
from marey_schemas.formats import UNITS_M
from marey_schemas.options.imports import Handedness, ImportOptions, UpAxis

CONVENTIONAL_UNITS = ("m", "cm", "mm")
# Lengths of the legs of adults, along the bones from the joint that carries both legs to the ankle. The range is so
# small that no length fits two units.
LEG_LENGTH_M = (0.72, 1.2)
# Lengths of the legs of bodies of any kind, such as children and animals.
ANY_LEG_LENGTH_M = (0.1, 1.5)

_MIRRORED_COSINE = -0.2
# Least height of the hips of a body that stands, as a share of the length of a leg.
_STANDING_SHARE = 0.7


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
    axis_is_clear: bool


def infer_conversion(
    source: SourceMotion, anatomy: Anatomy, file: str, options: ImportOptions, sibling_axis: UpAxis | None = None
) -> Conversion:
    """Determine the unit and the upward axis from the options, or else from the format, or else from the body.

    Parameters
    ----------
    source : SourceMotion    the file in its own unit and axes
    anatomy : Anatomy    anatomy of the source's skeleton
    file : str    name of the file, for messages
    options : ImportOptions    facts given by the user
    sibling_axis : str, optional    upward axis of other files with this skeleton

    Returns
    -------
    Conversion    unit, axes and evidence

    Raises
    ------
    AmbiguousUnits    if the body does not determine the unit or axis; the error names the option to set, and candidates
    ContradictedOption    if the body clearly contradicts a given unit or axis
    """
    body = measure_body(source, anatomy, file)
    up_axis = choose_up_axis(source, body, options, sibling_axis)
    unit_scale_m = _choose_unit(source, body, options, up_axis)
    _look_for_mirroring(source, body, options, up_axis)
    return Conversion(
        unit_scale_m, up_axis, options.handedness, tuple(body.evidence), tuple(body.warnings), body.axis_is_clear
    )


# Unit


def _choose_unit(source: SourceMotion, body: BodyMeasures, options: ImportOptions, up_axis: UpAxis) -> float:
    hip_height = hip_height_of(body, up_axis)
    if (given := options.metres_per_unit) is not None:
        _compare_with_legs(given, body, trusted=options.trust_options)
        body.evidence.append(f"unit {given:g} m: given by the user{_as_hips(hip_height, given)}")
        return given
    if (stated := source.unit_scale_m) is not None:
        legs_m = body.leg * stated if source.declared and body.leg is not None else None
        if legs_m is None or _within(ANY_LEG_LENGTH_M, legs_m):
            why = "; ".join(source.declared) or "fixed by the format"
            body.evidence.append(f"unit {stated:g} m: {why}{_as_hips(hip_height, stated)}")
            if legs_m is not None and not _within(LEG_LENGTH_M, legs_m):
                body.warnings.append(_doubtful_unit(stated, legs_m, "that the file states"))
            return stated
    if body.leg is None:
        raise AmbiguousUnits(
            "the unit of length is not clear: the file does not state it, and the skeleton has no two legs whose "
            "length could be measured; set the unit with --unit (unit), such as cm, or with --unit-scale-m "
            "(unit_scale_m), in metres",
            file=body.file,
        )
    return _unit_of_leg(body, hip_height, up_axis, stated)


def _compare_with_legs(given: float, body: BodyMeasures, *, trusted: bool) -> None:
    """Refuse a given unit in which the legs have an impossible length; warn if the length is not that of an adult."""
    if body.leg is None:
        return
    legs_m = body.leg * given
    if not _within(ANY_LEG_LENGTH_M, legs_m) and not trusted:
        fitting = [name for name, size in UNITS_M.items() if _within(LEG_LENGTH_M, body.leg * size)]
        reading = "".join(f"; with {name}, they are {body.leg * UNITS_M[name]:.2f} m long" for name in fitting)
        raise ContradictedOption(
            f"the unit of {given:.5g} m contradicts the body: its legs would be {legs_m:.3g} m long{reading}; name the "
            "right unit with --unit (unit), or confirm the given unit with --trust-options (trust_options)",
            file=body.file,
        )
    if body.landmarks.by_names and not _within(LEG_LENGTH_M, legs_m):
        body.warnings.append(_doubtful_unit(given, legs_m, "that was given"))


def _doubtful_unit(unit_m: float, legs_m: float, origin: str) -> CheckWarning:
    low, high = LEG_LENGTH_M
    return CheckWarning(
        "unit-doubtful",
        f"with the unit {origin} ({unit_m:.5g} m), the legs are {legs_m:.2f} m long (adults have {low} to "
        f"{high} m); if the body is an adult's, set the right unit with --unit (unit) or --unit-scale-m (unit_scale_m)",
        values={"unit_scale_m": unit_m, "leg_length_m": legs_m},
    )


def _unit_of_leg(body: BodyMeasures, hip_height: float, up_axis: UpAxis, stated: float | None) -> float:
    assert body.leg is not None
    (low, high), known, reason = LEG_LENGTH_M, tuple(UNITS_M), "legs"
    # The names of a known rig have precedence over the motion: people crawl and turn cartwheels, too.
    if not body.landmarks.by_names and walks_on_hands(body, up_axis):
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


def _ambiguous_unit(body: BodyMeasures, hip_height: float) -> AmbiguousUnits:
    assert body.leg is not None
    by_fit = sorted(UNITS_M, key=lambda name: abs(np.log((body.leg or 1.0) * UNITS_M[name] / 0.9)))
    listed = [
        f"{name} (legs {body.leg * UNITS_M[name]:.2f} m, hips {hip_height * UNITS_M[name]:.2f} m)"
        for name in by_fit[:3]
    ]
    low, high = LEG_LENGTH_M
    fitting = [name for name, size in UNITS_M.items() if _within(LEG_LENGTH_M, body.leg * size)]
    fit = f"fit {' or '.join(fitting)}, but the names of the joints are not known" if fitting else "fit no known unit"
    return AmbiguousUnits(
        f"the unit of length is not clear: legs of {body.leg:.4g} units {fit} (adults have {low} to {high} m); "
        f"set the unit with --unit (unit) or --unit-scale-m (unit_scale_m); candidates: {', '.join(listed)}",
        file=body.file,
    )


def _within(bounds: tuple[float, float], value: float) -> bool:
    return bounds[0] <= value <= bounds[1]


def _as_hips(hip_height: float, scale: float) -> str:
    return f", hips {hip_height * scale:.2f} m above the ground" if hip_height > 0 else ""


# Handedness


def _look_for_mirroring(source: SourceMotion, body: BodyMeasures, options: ImportOptions, up_axis: UpAxis) -> None:
    """Warn if left and right seem exchanged.

    A body that stands faces where its feet point. Left and right seem exchanged if the left leg is then on the right.
    Frames in which the body kneels, lies or crawls show nothing, because the feet point down or back in them; if the
    body never stands, its rest pose is examined.
    """
    landmarks = body.landmarks
    if landmarks.feet is None or landmarks.toes is None or options.handedness == "left":
        return
    poses = _standing(body, body.positions, up_axis)
    if not poses.size:
        poses = _standing(body, body.rest[:, None], up_axis)
    up = np.zeros(3)
    up["xyz".index(up_axis[-1])] = -1.0 if up_axis[0] == "-" else 1.0
    left, right = (mean_point(poses, _leg_joints(source.parents, landmarks, foot)) for foot in landmarks.feet)
    leftwards = left - right
    # The lower foot stands; the other may point anywhere.
    feet, toes = (poses.take(pair, axis=0) for pair in (landmarks.feet, landmarks.toes))
    standing = heights_along(feet, up_axis).argmin(axis=0)
    x, y, z = (toes - feet)[standing, np.arange(len(standing))].T
    expected = np.empty_like(leftwards)
    expected[:, 0], expected[:, 1], expected[:, 2] = up[1] * z - up[2] * y, up[2] * x - up[0] * z, up[0] * y - up[1] * x
    scale = float(np.add.reduce(lengths_of(expected) * lengths_of(leftwards)))
    cosine = float(np.add.reduce(expected * leftwards, axis=None)) / scale if scale > 0 else 0.0
    if cosine < _MIRRORED_COSINE:
        body.warnings.append(
            CheckWarning(
                "left-handed",
                "seen in the direction in which the feet point, the left leg is on the right (mean cosine of the angle "
                f"between the body's left and the line from the right to the left leg: {cosine:.2f}); the file may be "
                "left-handed; if so, import it with the option handedness=left",
                values={"cosine": cosine},
            )
        )


def _standing(body: BodyMeasures, positions: NDArray[np.float64], up_axis: UpAxis) -> NDArray[np.float64]:
    """Select the frames of positions (J, F, 3) in which the body stands: the hips are nearly a leg above the feet."""
    landmarks = body.landmarks
    assert landmarks.feet is not None
    assert body.leg is not None
    above = heights_along(positions, up_axis)
    heights = above[landmarks.hips] - above.take(landmarks.feet, axis=0).min(axis=0)
    return positions[:, heights > _STANDING_SHARE * body.leg]


def _leg_joints(parents: NDArray[np.int32], landmarks: Landmarks, foot: int) -> list[int]:
    """List the joints from a foot up to the hips, without the hips."""
    joints = [foot]
    while int(parents[joints[-1]]) != landmarks.hips:
        joints.append(int(parents[joints[-1]]))
    return joints
