"""Inference of the axis of a file that points up: the head is above the feet, or the feet stay at one height."""

from __future__ import annotations

from collections import defaultdict
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import AmbiguousUnits, ContradictedOption
from marey_motion.importing.body_measures import (
    BodyMeasures,
    heights_along,
    hip_height_of,
    lengths_of,
    mean_point,
    walks_on_hands,
)
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.landmarks import Landmarks
from marey_motion.importing.order_statistics import low_quantile, median
from marey_motion.importing.source import SourceMotion
from marey_schemas.options.imports import ImportOptions, UpAxis

_CLEAR_COSINE = 0.8
# Below this cosine between legs and trunk, the pose is not one of a body: all bones are on one line.
_FOLDED_COSINE = -0.9
_FOLDED = "rest pose that no body can have, with head and feet on the same side of the hips"
_FLAT_GROUND = 0.1
_CLEARLY_FLATTER = 3.0
# Sum of the cosines of motion and rest pose, along the same axis, that is as clear as one upright body.
_AGREEING_COSINES = 1.4
# Weights of the evidence for an axis if the rig is known by its names; a cosine of the motion is its own weight. The
# rest pose of a known rig counts most, because the body may lie, crawl or roll. Flat ground counts less, because the
# lowest point of a body that rolls also stays at one height along a horizontal axis.
_REST_VOTE, _FLAT_VOTE, _UPRIGHT_VOTE, _ALL_FOURS_VOTE, _GROUND_VOTE = 1.5, 0.6, 0.8, 0.9, 0.4
# The body is on the ground along this axis, but not along the axis of its rest pose.
_ONLY_GROUND_VOTE = 1.0
# Lead of the best axis over the second best below which the user is asked.
_CLEAR_LEAD = 0.6


def choose_up_axis(
    source: SourceMotion, body: BodyMeasures, options: ImportOptions, sibling_axis: UpAxis | None
) -> UpAxis:
    """Determine the upward axis from the options, or else from the format, or else from the body.

    Parameters
    ----------
    source : SourceMotion    the file in its own unit and axes
    body : BodyMeasures    measures of the file; receives the evidence and warnings
    options : ImportOptions    facts given by the user
    sibling_axis : str, optional    upward axis of other files with this skeleton, for a file that does not show its own

    Returns
    -------
    str    axis, with a minus sign if it points down; "y", with a warning, if no feet were found in the file

    Raises
    ------
    AmbiguousUnits    if the body does not determine the axis although its feet were found; the error names the option
        to set, and candidates
    ContradictedOption    if the body clearly stands along another axis than the given one
    """
    if options.up_axis is not None:
        _compare_with_body(options.up_axis, body, trusted=options.trust_options)
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
    return _infer_up_axis(body, sibling_axis)


def _infer_up_axis(body: BodyMeasures, sibling_axis: UpAxis | None) -> UpAxis:
    """Infer the upward axis from motion, rest pose and ground, and add the evidence to `body`.

    `sibling_axis`, the axis of other files with this skeleton, is used unless the motion clearly stands along y, or the
    body is on all fours and not a person.
    """
    standing, resting = _body_axis(body.positions, body.landmarks), _body_axis(body.rest[:, None], body.landmarks)
    flat = _flat_axis(body)
    is_person = body.landmarks.by_names and resting[1] >= _CLEAR_COSINE
    on_fours = flat is not None and flat[0] != standing[0] and _stands_on_all_fours(body, flat[0])
    if flat is not None and on_fours and not is_person:
        body.evidence.append(f"up axis {flat[0]}: hands and feet are below the hips; {flat[1]}")
        body.axis_is_clear = True
        return flat[0]
    # Along y, a person may lie in a file with z up; a rest pose with z up may stand in a file with y up.
    is_undoubted = not is_person or resting[0] == "y" or _stands_on_origin(body, "y")
    if standing[0] == "y" and standing[1] >= _CLEAR_COSINE and is_undoubted and not on_fours:
        body.evidence.append(
            f"up axis y: head above feet, mean cosine {standing[1]:.2f} over {body.positions.shape[1]} frames"
        )
        body.axis_is_clear = True
        return "y"
    if sibling_axis is not None:
        observed = _observed_axes(standing, resting)
        body.evidence.append(f"up axis {sibling_axis}: other files with this skeleton have it; {observed}")
        return sibling_axis
    if is_person:
        axis = _axis_of_person(body, standing, resting, flat, on_fours=on_fours)
    else:
        axis = _axis_of_tilted_body(body, *standing, flat)
    body.axis_is_clear = axis == standing[0] and standing[1] >= _CLEAR_COSINE
    return axis


def _axis_of_person(
    body: BodyMeasures,
    standing: tuple[UpAxis, float],
    resting: tuple[UpAxis, float],
    flat: tuple[UpAxis, str] | None,
    *,
    on_fours: bool,
) -> UpAxis:
    """Choose the upward axis of a known rig by weighing rest pose, motion and ground together.

    `standing` and `resting` are the axes nearest to the direction from feet to head in the motion and in the rest pose,
    with cosines. `flat` is the axis along which the lowest point of the body hardly moves, with the evidence in words,
    or None. `on_fours` is true if hands and feet are below the hips along this axis.
    """
    votes: dict[UpAxis, float] = defaultdict(float)
    votes[resting[0]] += _REST_VOTE
    votes[standing[0]] += standing[1]
    if flat is not None:
        votes[flat[0]] += _FLAT_VOTE + _ALL_FOURS_VOTE * on_fours
    level = [axis for axis in get_args(UpAxis) if _stands_on_origin(body, axis) and _keeps_to_ground(body, axis)]
    grounded = [axis for axis in votes if _stands_on_origin(body, axis)]
    ground = list(dict.fromkeys([*grounded, *level]))
    for axis in ground:
        votes[axis] += _GROUND_VOTE
    if resting[0] not in grounded:
        for axis in level:
            votes[axis] += _ONLY_GROUND_VOTE
    upright_on_ground = grounded == [standing[0]] or (flat is not None and flat[0] == standing[0])
    if standing[1] >= _CLEAR_COSINE and upright_on_ground:
        votes[standing[0]] += _UPRIGHT_VOTE
    best, *others = sorted(votes, key=lambda axis: -votes[axis])
    borne = f"; along {' and '.join(ground)}, the body stands on the plane through the origin" if ground else ""
    observed = _observed_axes(standing, resting) + borne + ("" if flat is None else f"; {flat[1]}")
    if others and votes[best] - votes[others[0]] < _CLEAR_LEAD:
        raise _unclear_axis(body, observed, standing, resting)
    body.evidence.append(f"up axis {best}: the joints have the names of a known rig; {observed}")
    return best


def _compare_with_body(given: UpAxis, body: BodyMeasures, *, trusted: bool) -> None:
    """Refuse a given axis that the motion and the rest pose or the ground contradict; warn if only the motion does.

    A body may lie or do a handstand in the whole motion, so the motion alone is weak evidence. But such a body stays at
    one height along the axis that points up: if its lowest point moves along the given axis, the axis is wrong.
    """
    if body.leg is None:
        return
    axis, cosine = _body_axis(body.positions, body.landmarks)
    rest_axis, rest_cosine = _body_axis(body.rest[:, None], body.landmarks)
    flat = _flat_axis(body)
    others = {rest_axis} if rest_cosine >= _CLEAR_COSINE else set()
    others |= {flat[0]} if flat is not None else set()
    if axis == given or cosine < _CLEAR_COSINE or given in others:
        return
    reason = f"from feet to head, the body points along {axis} (mean cosine {cosine:.2f}), not along {given}"
    if (axis in others or not _keeps_to_ground(body, given)) and not trusted:
        raise ContradictedOption(
            f"the up axis {given} contradicts the motion: {reason}; set the right axis with --up-axis (up_axis), "
            "or confirm the given axis with --trust-options (trust_options)",
            file=body.file,
        )
    body.warnings.append(CheckWarning("up-axis-doubtful", reason, values={"up_axis": axis, "cosine": cosine}))


def _axis_of_tilted_body(body: BodyMeasures, axis: UpAxis, cosine: float, flat: tuple[UpAxis, str] | None) -> UpAxis:
    """Choose the upward axis of a body that is not upright along y: it lies or climbs, or another axis points up.

    `axis` is the axis nearest to the direction from feet to head, and `cosine` is the cosine of the angle between this
    axis and the direction. `flat` is the axis along which the lowest point of the body hardly moves, with the evidence
    in words; None if there is no such axis.
    """
    rest_axis, rest_cosine = _body_axis(body.rest[:, None], body.landmarks)
    observed = _observed_axes((axis, cosine), (rest_axis, rest_cosine))
    agreed = rest_axis == axis and cosine + rest_cosine >= _AGREEING_COSINES
    if agreed and (flat is None or flat[0] == axis or min(cosine, rest_cosine) >= _CLEAR_COSINE):
        body.evidence.append(f"up axis {axis}: {observed}")
        return axis
    if flat is not None:
        body.evidence.append(f"up axis {flat[0]}: {flat[1]}; {observed}")
        return flat[0]
    if cosine >= _CLEAR_COSINE:
        grounded = [candidate for candidate in (axis, rest_axis) if _stands_on_origin(body, candidate)]
        if len(set(grounded)) == 1:
            body.evidence.append(f"up axis {grounded[0]}: the body stands on the plane through the origin; {observed}")
            return grounded[0]
    raise _unclear_axis(body, observed, (axis, cosine), (rest_axis, rest_cosine))


def _observed_axes(standing: tuple[UpAxis, float], resting: tuple[UpAxis, float]) -> str:
    """Describe the upward axes that the motion and the rest pose show, for a message."""
    motion = f"mean direction from feet to head is {standing[0]} with cosine {standing[1]:.2f}"
    if standing[1] == 0.0:
        motion = f"the motion keeps to a {_FOLDED}"
    rest = f"rest pose points along {resting[0]} with cosine {resting[1]:.2f}"
    return f"{motion}; {_FOLDED if resting[1] == 0.0 else rest}"


def _unclear_axis(
    body: BodyMeasures, observed: str, standing: tuple[UpAxis, float], resting: tuple[UpAxis, float]
) -> AmbiguousUnits:
    return AmbiguousUnits(
        f"the file does not show clearly which axis points up ({observed}); name the axis with --up-axis (up_axis), "
        f"one of {_likely_axes(standing, resting)}",
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
    feet, hips = mean_point(positions, landmarks.feet), positions[landmarks.hips]
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
    lengths = lengths_of(ways)
    lengths[lengths == 0] = 1.0
    mean: NDArray[np.float64] = np.add.reduce(ways / lengths[..., None], axis=1) / ways.shape[1]
    return mean


def _flat_axis(body: BodyMeasures) -> tuple[UpAxis, str] | None:
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


def _stands_on_origin(body: BodyMeasures, axis: UpAxis) -> bool:
    """Return whether the body stands on the plane through the origin that is perpendicular to `axis`."""
    assert body.leg is not None
    lowest = heights_along(body.positions, axis).min(axis=0)
    return bool(abs(low_quantile(lowest)) <= _FLAT_GROUND * body.leg)


def _keeps_to_ground(body: BodyMeasures, axis: UpAxis) -> bool:
    """Return whether the lowest point of the body hardly moves along an axis."""
    assert body.leg is not None
    lowest = heights_along(body.positions, axis).min(axis=0)
    return bool(lowest.std() <= _FLAT_GROUND * body.leg)


def _axis_name(axis: int, sign: float) -> UpAxis:
    names: tuple[UpAxis, ...] = ("x", "y", "z") if sign >= 0 else ("-x", "-y", "-z")
    return names[axis]


# With 64 poses, numpy's ufuncs are faster than its `std`, and give the same bits.
def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the standard deviation (k,) over the first axis of (F, k)."""
    deviations = values - np.add.reduce(values, axis=0) / len(values)
    spread: NDArray[np.float64] = np.sqrt(np.add.reduce(deviations * deviations, axis=0) / len(values))
    return spread


def _stands_on_all_fours(body: BodyMeasures, up_axis: UpAxis) -> bool:
    """Return whether hands and feet are near one ground, well below the hips; False if the body lies on its side."""
    assert body.leg is not None
    return walks_on_hands(body, up_axis) and hip_height_of(body, up_axis) > 0.5 * body.leg
