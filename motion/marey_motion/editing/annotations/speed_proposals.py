"""Proposals of segments and keyframes at pauses and reaching movements, for people to review."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import runs
from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import MappingError
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs.standard import SIDES
from marey_schemas.options.annotations import OUT_OF_REST, VelocityMinimaProposal, WristContactProposal

PAUSE = "pause"
MOVEMENT = "movement"
CONTACT = "contact"
RELEASE = "release"
REST_S = 0.1


def propose_pauses(clip: Clip, joints: Sequence[int] = (), options: VelocityMinimaProposal | None = None) -> Layer:
    """Propose a keyframe `pause` at each deep minimum of the joints' mean speed, and segments `movement` between them.

    The depth of a minimum, and the time between two minima, must reach the limits in `options`. The first segment
    starts with the clip, and the last segment ends with the clip.

    Parameters
    ----------
    clip : Clip    F frames
    joints : sequence of int    indices of the joints; all joints if empty
    options : VelocityMinimaProposal, optional    limits

    Returns
    -------
    Layer    the proposal; an empty layer if the joints never move
    """
    from scipy.signal import find_peaks  # imported here, because this import is slow

    options = options or VelocityMinimaProposal()
    positions = kinematics.global_positions(clip)
    moving = positions[:, list(joints)] if joints else positions
    speed = np.linalg.norm(kinematics.velocities(moving, clip.frame_rate_hz), axis=-1).mean(axis=1)
    speed = _smooth(speed, options.smoothing_s, clip.frame_rate_hz)
    highest = float(speed.max())
    if highest <= 0.0:
        return Layer(clip.frame_count)
    pauses, _ = find_peaks(
        -speed,
        prominence=options.least_depth * highest,
        distance=max(1.0, options.least_apart_s * clip.frame_rate_hz),
    )
    bounds = [0, *pauses.tolist(), clip.frame_count]
    segments = tuple(Segment(MOVEMENT, *pair) for pair in pairwise(bounds))
    return Layer(clip.frame_count, segments, tuple(Keyframe(PAUSE, frame) for frame in bounds[1:-1]))


def propose_reaches(clip: Clip, body: MatchingBody, options: WristContactProposal | None = None) -> Layer:
    """Propose a segment `reach_left` or `reach_right` each time the wrist leaves its rest position and returns.

    Only the wrist of `options.hand` is considered; for "either", the wrist that moves farther from rest. The rest
    position is the position of the wrist at the start of the clip: horizontally relative to the hips and the body's
    heading, vertically the height above the ground. A segment begins and ends where the distance of the wrist from rest
    has a minimum. In each segment, the keyframe `contact` marks the first frame in which this distance is at least
    `options.arrived` times its maximum; if `options.release` is set, the keyframe `release` marks the last such frame.

    Parameters
    ----------
    clip : Clip    F frames
    body : MatchingBody    joints of its skeleton
    options : WristContactProposal, optional    limits

    Returns
    -------
    Layer    the proposal; movements that stay closer to rest than `options.least_reach_m` have no segment

    Raises
    ------
    MotionError    if the body has no facing direction or lacks the wrist
    """
    options = options or WristContactProposal()
    distances = {side: _distance_from_rest(clip, body, side) for side in SIDES if options.hand in (side, "either")}
    side = max(distances, key=lambda name: float(distances[name].max()))
    distance, farthest = distances[side], float(distances[side].max())
    if farthest < options.least_reach_m:
        return Layer(clip.frame_count)
    segments: list[Segment] = []
    keyframes: list[Keyframe] = []
    for start, end in runs(distance >= max(OUT_OF_REST * farthest, 1e-9)):
        there = distance[start:end] >= options.arrived * float(distance[start:end].max())
        if float(distance[start:end].max()) < options.least_reach_m:
            continue
        left = _downhill(distance, start, -1, segments[-1].end if segments else 0)
        right = _downhill(distance, end - 1, 1, clip.frame_count - 1)
        segments.append(Segment(f"reach_{side}", left, right + 1))
        frames = np.flatnonzero(there) + start
        keyframes.append(Keyframe(CONTACT, int(frames[0])))
        if options.release:
            keyframes.append(Keyframe(RELEASE, int(frames[-1])))
    return Layer(clip.frame_count, tuple(segments), tuple(keyframes))


def _distance_from_rest(clip: Clip, body: MatchingBody, side: str) -> Floats:
    """Compute the distance (F,), in metres, of the wrist on a `side` from its rest position (see `propose_reaches`)."""
    wrist = body.standard_joints.get(f"{side}_wrist")
    if wrist is None:
        raise MappingError(
            "the joint mapping of the skeleton contains no joint for the wrist; add it to the mapping",
            where=f"{side}_wrist",
        )
    positions = kinematics.global_positions(clip).astype(np.float64)
    forward = kinematics.forward_directions(positions, body.lefts, body.rights)
    x, z = (positions[:, wrist] - positions[:, body.hips])[:, (0, 2)].T
    seen = np.stack(
        (z * forward[:, 0] - x * forward[:, 1], positions[:, wrist, 1], x * forward[:, 0] + z * forward[:, 1]), axis=1
    )
    seen = _smooth(seen, 0.5 * REST_S, clip.frame_rate_hz)
    at_rest = seen[: max(1, round(REST_S * clip.frame_rate_hz))].mean(axis=0)
    return np.asarray(np.linalg.norm(seen - at_rest, axis=1))


def _downhill(values: Floats, frame: int, step: Literal[-1, 1], last: int) -> int:
    """Find the first frame, from `frame` towards `last` in steps of `step`, after which the values stop falling."""
    way = values[last : frame + 1][::-1] if step == -1 else values[frame : last + 1]
    rising = np.diff(way) >= 0.0
    return frame + step * (int(np.argmax(rising)) if rising.any() else len(way) - 1)


def _smooth(values: Floats, deviation_s: float, frame_rate_hz: float) -> Floats:
    from scipy.ndimage import gaussian_filter1d  # imported here, because this import is slow

    smoothed = gaussian_filter1d(values.astype(np.float64), deviation_s * frame_rate_hz, axis=0, mode="nearest")
    return np.asarray(smoothed)
