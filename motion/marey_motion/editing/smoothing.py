"""Removal of noise from rotations and translations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.editing.borders import blended, range_weights
from marey_motion.editing.compute_budget import MOST_OF_TAPS, PER_TAP
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.kept_feet import feet_as_motion, feet_of, with_feet
from marey_motion.editing.take import Take
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_schemas.editing.commands import Smooth

LONG_WINDOW = 512
"""Longest window, in frames, over which means are computed directly; longer windows use Fourier transforms.

The cost of Fourier transforms hardly depends on the length of the window.
"""
CHANNELS_AT_ONCE = 32
"""Channels that are transformed together. The number is limited because a Fourier transform takes several times the
memory of its input.
"""

LEAST_LENGTH = 0.1
"""Minimum length of a mean of unit quaternions; rotations with a shorter mean differ too much to be averaged."""


def smooth(take: Take, command: Smooth) -> Take:
    """Replace the path of the root, and rotations and translations of joints, with weighted averages over time.

    No frame is lost: beyond each end, the motion is continued by its own reflection through the end pose. Therefore the
    first and the last frame, and straight paths, do not change. Rotations are averaged as quaternions of continuous
    sign and then normalised.

    Parameters
    ----------
    take : Take    F frames
    command : Smooth    the filter, its width (for a gaussian, six standard deviations), joints, range and borders. If
        the path of the root is smoothed, so are the translations of joints between root and pelvis.

    Returns
    -------
    Take    F frames

    Raises
    ------
    UnknownJoint    if a joint does not exist; the error names it
    EditError    if the take lacks one of the frames, if the window is too short for the polynomials, or if a joint
        spins so fast that its rotations have no mean
    """
    motion = take.motion
    span, shares = range_weights(take, command.frames, command.border_s)
    every = range(take.skeleton.joint_count)
    chosen = list(every) if command.joints is None else sorted({take.joint(one) for one in command.joints})
    columns = slice(None) if command.joints is None else chosen
    weights = _weights(take, command)
    if command.window_s * take.frame_rate_hz > 2.0 * take.frame_count:
        take = take.with_warning(
            "smooth", f"the window of {command.window_s:g} s is longer than the clip, so it was shortened"
        )
    take.budget.spend(take.size * min(PER_TAP * len(weights), MOST_OF_TAPS))
    root, rotations, translations = motion.root_translations.copy(), motion.rotations.copy(), motion.translations.copy()
    if command.root_translation:
        root[span] += shares[:, None] * (_smooth_positions(root, weights) - root)[span]
    smoothed = _smooth_rotations(take, rotations[:, columns], weights, chosen)[span]
    rotations[span, columns] = blended(rotations[span, columns], smoothed, shares)
    carriers = take.skeleton.path_to_root(take.body.pelvis) if motion.translated_joints else ()
    moved = [command.root_translation if joint in carriers else joint in chosen for joint in motion.translated_joints]
    steps = _smooth_positions(translations[:, moved], weights) - translations[:, moved]
    translations[span, moved] += shares[:, None, None] * steps[span]
    made = motion._replace(root_translations=root, rotations=rotations, translations=translations)
    return take.with_motion(_with_kept_feet(take, made, weights, span, shares) if command.keep_feet else made)


def _with_kept_feet(take: Take, smoothed: Motion, weights: Floats, span: slice, shares: Floats) -> Motion:
    """Smooth the positions of the feet in the world, and keep each sole above its lowest height within the window."""
    from scipy.ndimage import minimum_filter1d

    feet = feet_of(take)
    if not feet:
        return smoothed
    ankles = [foot.leg.end for foot in feet]
    moved = (smoothed.rotations != take.motion.rotations).any(axis=(0, 2))
    roots = (smoothed.root_translations != take.motion.root_translations).any()
    if not roots and not any(moved[list(take.skeleton.path_to_root(ankle))].any() for ankle in ankles):
        return smoothed
    given = feet_as_motion(take.skeleton, take.motion, feet)
    places, spins = given.translations.copy(), given.rotations.copy()
    places[span] += shares[:, None, None] * (_smooth_positions(places, weights) - places)[span]
    spins[span] = blended(spins[span], _smooth_rotations(take, spins, weights, ankles)[span], shares)
    soles = heights_of_soles(take.skeleton, take.motion, ankles)
    floors = minimum_filter1d(soles, len(weights), axis=0, mode="nearest")
    return with_feet(take, smoothed, feet, given._replace(translations=places, rotations=spins), floors, span)


def _weights(take: Take, command: Smooth) -> Floats:
    """Compute symmetric weights (2 n + 1,) that sum to 1; a window longer than the motion is shortened."""
    asked = max(1, int(0.5 * command.window_s * take.frame_rate_hz + 1e-9))
    reach = min(asked, take.frame_count - 1)
    if command.method == "gaussian":
        bell = np.exp(-0.5 * (3.0 * np.arange(-reach, reach + 1) / asked) ** 2)
        return np.asarray(bell / bell.sum(), dtype=np.float64)
    from scipy.signal import savgol_coeffs

    order = command.order
    if order > 2 * asked:
        raise EditError(
            f"a window of {2 * asked + 1} frames is too short for polynomials of degree {order}; at "
            f"{take.frame_rate_hz:g} Hz it needs at least {2 * ((order + 1) // 2) / take.frame_rate_hz:.3g} s",
            code="window-too-short",
            where="window_s",
        )
    return np.asarray(savgol_coeffs(2 * reach + 1, min(order, 2 * reach)), dtype=np.float64)


def _smooth_positions(values: Floats, weights: Floats) -> Floats:
    """Compute the weighted means over time of positions (F, ...)."""
    reach = len(weights) // 2
    before = 2.0 * values[0] - values[reach:0:-1]
    after = 2.0 * values[-1] - values[-2 : -reach - 2 : -1]
    return _averaged(np.concatenate((before, values, after)), weights)


def _smooth_rotations(take: Take, rotations: Floats, weights: Floats, joints: Sequence[int]) -> Floats:
    """Compute the weighted means over time of rotations (F, J, 4) of `joints`, normalised.

    Raises `EditError` if a joint turns so fast that its rotations have no mean.
    """
    reach = len(weights) // 2
    before = _reflected(rotations[0], rotations[reach:0:-1])
    after = _reflected(rotations[-1], rotations[-2 : -reach - 2 : -1])
    means: Floats = _averaged(np.concatenate((before, rotations, after)), weights)
    lengths = np.sqrt(np.einsum("fjc,fjc->fj", means, means))
    if lengths.size and lengths.min() < LEAST_LENGTH:
        frame, joint = np.unravel_index(int(np.argmin(lengths)), lengths.shape)
        raise EditError(
            f"the joint turns by a full circle within one smoothing window, around frame {frame}; choose a "
            "shorter window",
            code="window-too-long",
            where=f"joint {take.skeleton.joint_names[joints[int(joint)]]}",
        )
    means /= lengths[..., None]
    return means


def _reflected(end: Floats, rotations: Floats) -> Floats:
    """Reflect rotations (n, J, 4) through the rotations `end` (J, 4) of an end frame.

    A reflected rotation differs from the rotation of the end frame by the same angle as before, but in the opposite
    direction.
    """
    back = quaternions.multiply(end, quaternions.multiply(quaternions.conjugate(rotations), end))
    return np.asarray(back, dtype=np.float64)


def _averaged(padded: Floats, weights: Floats) -> Floats:
    """Compute the weighted mean (F, ...) of the frames around each frame.

    `padded` (n + F + n, ...) are the values of all frames, extended by n frames at either end; `weights` (2 n + 1,)
    are the weights of the n frames before a frame, of the frame itself, and of the n frames after it.
    """
    from scipy.ndimage import correlate1d

    reach = len(weights) // 2
    if len(weights) > LONG_WINDOW:
        return _averaged_long(padded, weights)
    return np.asarray(correlate1d(padded, weights, axis=0)[reach : len(padded) - reach], dtype=np.float64)


def _averaged_long(padded: Floats, weights: Floats) -> Floats:
    from scipy.signal import oaconvolve

    channels = padded.reshape(len(padded), int(np.prod(padded.shape[1:])))
    means = np.empty((len(padded) - len(weights) + 1, channels.shape[1]))
    for first in range(0, channels.shape[1], CHANNELS_AT_ONCE):
        part = slice(first, first + CHANNELS_AT_ONCE)
        means[:, part] = oaconvolve(channels[:, part], weights[:, None], mode="valid", axes=0)
    return means.reshape(len(means), *padded.shape[1:])
