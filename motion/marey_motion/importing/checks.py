"""Warnings about a motion before it is used: one per finding, each with a stable code.

The checks never change anything; `without_rest_pose` and `on_the_floor` make a changed clip on request.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.importing.landmarks import Landmarks, common_ancestor, path_length
from marey_motion.importing.tracks import Tracks, track
from marey_schemas.wording import counted

# The codes of warnings, with their meaning for readers of an import report.
CODES = {
    # Content of the file, and how it was read.
    "frame-count-mismatch": "The file has more or fewer frames than its header declares; all were imported.",
    "frames-wrapped": "Frames are divided into several lines; the lines were joined by counting values.",
    "keyframes-at-end": "Keyframes at the end of the motion were moved from after the last frame to the last frame.",
    "tree-pickled": "A tree in a zipped graph is a pickle. Pickles are programs and never read; build the tree again.",
    "transitions-ignored": "Transitions of a zipped graph lead from or to nodes that do not exist; they were left out.",
    "credentials-in-file": "The file contains credentials; they are hidden, but remain in the file.",
    "no-frames": "The file contains no motion; only its skeleton was imported.",
    "frame-time-snapped": "The frame time in the file is rounded; the nearest usual frame rate was used.",
    "frame-rate-unusual": "The frame rate is close to a usual one, but not equal to it; it was not changed.",
    "frame-rate-doubtful": "The frame rate is below 10 Hz or above 1,000 Hz, which hardly any recording has.",
    "frame-rate-assumed": "The file contains no frame rate; the usual rate of its source was assumed.",
    "frame-number-gap": "The frame numbers have gaps; the frames were joined without gaps.",
    "mixed-rotation-orders": "The order of Euler angles differs between joints; each joint was read in its own order.",
    "duplicate-joint-names": "Several joints have the same name; the name of the parent was added to make them unique.",
    "position-channels": "Joints below the root move relative to their parents; their translations were kept.",
    "bones-moved-by-translations": "Bones follow the positions of the source's joints instead of their rotations.",
    "pelvis-from-hip-line": "The retargeted pelvis follows the line between the source's hips, because the rotation of "
    "the source's pelvis contradicts this line.",
    "dropped-joints-followed": "Retargeted bones of spine or neck were turned, because only one of the skeletons has "
    "some joints of spine or neck.",
    "axes-from-clip": "Axes of the source skeleton are unknown; they were read from the source clip.",
    "axes-guessed": "Axes of the target skeleton are unknown; they were guessed.",
    "below-floor": "Hands or feet of the retargeted clip are below the floor on which the source stands.",
    "feet-kept": "Feet of the retargeted clip were moved, so that they stay in place while the source's feet do so.",
    "knees-fast": "Knees of the retargeted clip bend faster than those of the source, because feet are kept in place.",
    "edit-warning": "A command of an edit reported an unexpected property of its result; the message describes it.",
    "hands-kept": "Hands of the retargeted clip were moved to the scaled positions of the source's hands.",
    "soles-moved-to-floor": "The retargeted clip was moved up or down, because its soles were off the floor.",
    "offsets-from-positions": "The file contains no bone lengths; they were computed from the position channels.",
    "position-channels-relative": "The position channels contain displacements from the offsets instead of positions.",
    "non-unit-quaternions": "Some quaternions did not have length 1; they were normalised.",
    "sign-flips-unrolled": "Rotations jumped between a quaternion and its negative; the signs were made continuous.",
    # Inferred properties.
    "unit-inferred": "The file states no unit of length, or an impossible one; the unit was inferred from the body.",
    "unit-doubtful": "With the unit of length that the file states, or that was given, the legs are shorter or longer "
    "than those of an adult.",
    "up-axis-assumed": "The file does not show which axis points up; y was assumed.",
    "up-axis-doubtful": "From feet to head, the body does not point along the upward axis that was given.",
    "up-axis-converted": "The upward axis of the file is not y; the motion was rotated.",
    "left-handed": "Left and right joints seem to be exchanged: the axes of the file may be left-handed.",
    # Defects of the motion.
    "rest-pose-frame": "A rest pose at the beginning or end of the motion falsifies averages; it can be trimmed.",
    "floor-offset": "The floor under the feet is above or below height zero.",
    "floor-penetration": "In some frames, feet are more than 5 cm below the ground on which the body stands.",
    "foot-skate": "Feet slide while they are on the ground.",
    "in-place-gait": "The body walks in place, as on a treadmill; leave the clip out of the coverage of speeds.",
    "teleport": "The root jumps between two frames.",
    "rotation-jump": "A joint rotates by an implausibly large angle between two frames.",
    "uneven-limbs": "Left and right leg, or left and right arm, differ much in length; a bone may be missing or wrong.",
    "dead-joints": "Some limbs never move, although other joints do.",
}

REST_TOLERANCE_RAD = 0.01
FLOOR_TOLERANCE_M = 0.1
PENETRATION_M = 0.05
SKATE_HEIGHT_M = 0.025
SKATE_SPEED_M_S = 0.6
IN_PLACE_FOOT_SPEED_M_S = 0.4
TELEPORT_SPEED_M_S = 15.0
REST_JUMP_M_S = 8.0
"""Speed in metres per second: if a point of the body is faster between rest pose and motion, the body jumps there."""
UNEVEN = 0.8
"""Length of a limb divided by that of the limb on the other side, below which the limbs are uneven."""
JUMP_RAD = np.radians(60.0)
# Cosine of half of an angle that is smaller than JUMP_RAD by more than any rounding error.
_SURELY_NO_JUMP = np.cos(JUMP_RAD / 2) + 1e-3
_FRAMES_AT_A_LOOK = 64


@dataclass(frozen=True)
class CheckWarning:
    """One finding about a motion; `CODES` explains every code.

    Parameters
    ----------
    code : str    short name of the kind of finding, for programs
    message : str    the finding, as a sentence with its numbers
    joints : tuple of str    names of the joints concerned
    frames : (int, int), optional    half-open range of the frames concerned, None for all of them
    values : dict    the numbers in the message
    """

    code: str
    message: str
    joints: tuple[str, ...] = ()
    frames: tuple[int, int] | None = None
    values: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Convert the warning to plain JSON types.

        Returns
        -------
        dict    one member per field
        """
        return {**asdict(self), "joints": list(self.joints), "frames": list(self.frames) if self.frames else None}


def check_clip(clip: Clip, landmarks: Landmarks | None = None) -> tuple[CheckWarning, ...]:
    """Check a clip for defects and peculiarities.

    Parameters
    ----------
    clip : Clip    F frames
    landmarks : Landmarks, optional    landmarks of its skeleton, if already known

    Returns
    -------
    tuple of CheckWarning    the findings
    """
    tracks = track(clip, landmarks)
    warnings = [_position_channels(clip), *_rest_poses(clip, tracks)]
    if tracks.body.soles:
        warnings += [_floor_offset(tracks), _floor_penetration(tracks), *_gait(clip, tracks)]
    warnings += [_teleports(clip), _rotation_jumps(clip), *_uneven_limbs(clip, tracks), _dead_joints(clip, tracks)]
    return tuple(warning for warning in warnings if warning is not None)


def without_rest_pose(clip: Clip) -> tuple[Clip, tuple[int, int]]:
    """Remove a rest pose at the start and end of a clip.

    Parameters
    ----------
    clip : Clip    F frames

    Returns
    -------
    clip : Clip    the frames that remain; the same clip if it has no rest pose, or if all its frames are a rest pose
    dropped : (int, int)    numbers of frames removed at the start and at the end
    """
    start, end = _rest_pose_frames(clip, track(clip))
    if start + end == 0 or start == clip.frame_count:
        return clip, (0, 0)
    return clip.sliced(start, clip.frame_count - end), (start, end)


def on_the_floor(clip: Clip) -> tuple[Clip, float]:
    """Move a clip so that its ground is at height zero.

    Parameters
    ----------
    clip : Clip    F frames

    Returns
    -------
    clip : Clip    the moved clip; the same clip if its skeleton has no feet
    shift_m : float    metres added to every height
    """
    tracks = track(clip)
    if not tracks.body.soles:
        return clip, 0.0
    shift_m = -tracks.floor_height
    poses = clip.poses.copy()
    poses[:, 1] += np.float32(shift_m)
    return replace(clip, poses=poses), shift_m


def _position_channels(clip: Clip) -> CheckWarning | None:
    if clip.translations is None:
        return None
    names = tuple(clip.skeleton.joint_names[joint] for joint in clip.translated_joints)
    moved = np.linalg.norm(clip.translations - clip.skeleton.offsets[list(clip.translated_joints)], axis=2)
    return CheckWarning(
        "position-channels",
        f"joints below the root that move relative to their parents: {len(names)}, most of all "
        f"{names[int(moved.max(axis=0).argmax())]}: by up to {moved.max():.3f} m",
        joints=names,
        values={"largest_m": float(moved.max())},
    )


# Rest pose


def _rest_poses(clip: Clip, tracks: Tracks) -> list[CheckWarning]:
    start, end = _rest_pose_frames(clip, tracks)
    found = []
    for place, first, last in (("begins", 0, start), ("ends", clip.frame_count - end, clip.frame_count)):
        if last > first:
            advice = "" if start == clip.frame_count else "; trim it with --trim-rest-pose (trim_rest_pose)"
            message = f"the motion {place} with {counted(last - first, 'frame')} of a rest pose{advice}"
            found.append(CheckWarning("rest-pose-frame", message, frames=(first, last)))
    return found


def _rest_pose_frames(clip: Clip, tracks: Tracks) -> tuple[int, int]:
    """Count the frames of a rest pose at the start and at the end of a clip; (F, 0) if all F frames are a rest pose.

    In a rest pose, nearly every joint has the rotation of the skeleton's rest pose, or the arms are held out in a T.
    """

    def resting(frames: slice) -> NDArray[np.bool_]:
        return _at_rest(clip, frames) | _in_t_pose(tracks, frames)

    # Most motions neither begin nor end at rest, or only for a moment; then the frames between need no look.
    count = clip.frame_count
    if not resting(slice(None, None, max(1, count - 1))).any():
        return 0, 0
    blocks = [slice(start, min(start + _FRAMES_AT_A_LOOK, count)) for start in range(0, count, _FRAMES_AT_A_LOOK)]
    start = _leading(resting(block) for block in blocks)
    if start == count:
        return count, 0
    return start, _leading(resting(block)[::-1] for block in reversed(blocks))


def rest_pose_jumps(clip: Clip) -> tuple[int, int]:
    """Count the frames of a rest pose at each end of a clip, if the body jumps between rest pose and motion.

    A rest pose from which the body moves smoothly is a part of the motion, and is not counted.

    Parameters
    ----------
    clip : Clip    F frames

    Returns
    -------
    (int, int)    frames at the start and at the end; 0 at an end without a jump; (0, 0) if all frames are a rest pose
    """
    tracks = track(clip)
    start, end = _rest_pose_frames(clip, tracks)
    if start == clip.frame_count:
        return 0, 0
    steps = np.linalg.norm(np.diff(tracks.positions, axis=0), axis=-1).max(axis=1) * clip.frame_rate_hz

    def jumps(step: int) -> bool:
        return bool(steps[step] > REST_JUMP_M_S)

    return start if start and jumps(start - 1) else 0, end if end and jumps(len(steps) - end) else 0


def _leading(blocks: Iterable[NDArray[np.bool_]]) -> int:
    """Count the true values before the first false value in a series of arrays; later arrays are not computed."""
    total = 0
    for block in blocks:
        if not block.all():
            return total + int(np.argmin(block))
        total += len(block)
    return total


def _at_rest(clip: Clip, frames: slice) -> NDArray[np.bool_]:
    """Find the frames (F,) in which at least 95 % of the joints below the root have nearly their rest rotation."""
    rotations = clip.rotations[frames, 1:]
    if rotations.shape[1] == 0:
        return np.zeros(len(rotations), np.bool_)
    rest = clip.skeleton.rest_rotations[1:].astype(np.float32)
    cosines = np.abs(np.einsum("fjc,jc->fj", rotations, rest))
    resting: NDArray[np.bool_] = (cosines >= np.cos(REST_TOLERANCE_RAD / 2)).mean(axis=1) >= 0.95
    return resting


def _in_t_pose(tracks: Tracks, frames: slice) -> NDArray[np.bool_]:
    """Find the frames (F,) with both arms stretched out level and the legs straight."""
    landmarks = tracks.body.landmarks
    seen = Tracks(tracks.body, tracks.positions[frames])
    if landmarks.hands is None or landmarks.feet is None or landmarks.hips is None:
        return np.zeros(len(seen.positions), np.bool_)
    span, leg = tracks.body.span_m, tracks.body.leg_m
    hands, feet, hips = seen.of(*landmarks.hands), seen.of(*landmarks.feet), seen.of(landmarks.hips)
    across = hands[:, 0] - hands[:, 1]
    apart = np.hypot(across[:, 0], across[:, 2]) > 0.9 * span
    level = np.abs(across[:, 1]) < 0.1 * span
    straight = hips[:, 0, 1] - feet[..., 1].max(axis=1) > 0.8 * leg
    result: NDArray[np.bool_] = apart & level & straight
    return result


# Feet and ground


def _floor_offset(tracks: Tracks) -> CheckWarning | None:
    height = tracks.floor_height
    if abs(height) <= FLOOR_TOLERANCE_M:
        return None
    return CheckWarning(
        "floor-offset",
        f"the floor under the feet is at a height of {height:.2f} m; --align-floor (align_floor) moves it to zero",
        values={"floor_height_m": height},
    )


def _floor_penetration(tracks: Tracks) -> CheckWarning | None:
    depths = tracks.floor_height - tracks.lowest
    below = np.flatnonzero(depths > PENETRATION_M)
    if below.size == 0:
        return None
    deepest = int(depths.argmax())
    return CheckWarning(
        "floor-penetration",
        f"feet are below the ground in {counted(below.size, 'frame')}, by {depths[deepest]:.2f} m in frame {deepest}",
        frames=(int(below[0]), int(below[-1]) + 1),
        values={"deepest_m": float(depths[deepest]), "frame": deepest, "frame_count": int(below.size)},
    )


def _gait(clip: Clip, tracks: Tracks) -> list[CheckWarning]:
    """Find feet that slide under a travelling body (skating), or under a body that does not travel (walking in place).

    The mean speed of the feet is weighted: a foot at height h above the ground has the weight 2 − 2^(h/H). A foot above
    H = 2.5 cm does not count. (Zhang et al., Mode-adaptive neural networks for quadruped control, 2018, section 7.3)
    """
    if clip.frame_count < 3:
        return []
    soles = tracks.soles
    heights = soles[1:, :, 1] - tracks.floor_height
    weights = 2.0 - 2.0 ** (heights.clip(0.0, SKATE_HEIGHT_M) / SKATE_HEIGHT_M)
    standing = float(weights.sum())
    if standing < 2:
        return []
    steps = _lengths(soles[1:, :, ::2] - soles[:-1, :, ::2])
    slide_m_s = float((steps * weights).sum()) / standing * clip.frame_rate_hz
    travel_m_s = _travel_speed(tracks.of(tracks.body.landmarks.hips or 0)[:, 0], clip.frame_rate_hz)
    values = {"slide_m_s": slide_m_s, "travel_m_s": travel_m_s}
    if slide_m_s > IN_PLACE_FOOT_SPEED_M_S and travel_m_s < 0.2 * slide_m_s:
        message = f"standing feet slide at {slide_m_s:.2f} m/s while the body travels {travel_m_s:.2f} m/s"
        return [CheckWarning("in-place-gait", message, values=values)]
    if slide_m_s > SKATE_SPEED_M_S:
        return [CheckWarning("foot-skate", f"standing feet slide at {slide_m_s:.2f} m/s on average", values=values)]
    return []


def _lengths(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the lengths (...) of vectors (..., k), bit for bit as `numpy.linalg.norm`, which takes longer."""
    lengths: NDArray[np.float32] = np.sqrt(np.add.reduce(vectors * vectors, axis=-1))
    return lengths


def _travel_speed(hips: NDArray[np.float32], frame_rate_hz: float) -> float:
    """Compute the mean speed (m/s) of hips (F, 3) on the ground, over spans so long that swaying does not count."""
    span = min(max(1, round(frame_rate_hz)), len(hips) - 1)
    ways = _lengths(hips[span:, ::2] - hips[:-span, ::2])
    return float(ways.mean()) / span * frame_rate_hz


# Continuity


def _teleports(clip: Clip) -> CheckWarning | None:
    speeds = _lengths(clip.root_translations[1:] - clip.root_translations[:-1]) * clip.frame_rate_hz
    jumps = np.flatnonzero(speeds > TELEPORT_SPEED_M_S)
    if jumps.size == 0:
        return None
    fastest = int(speeds.argmax())
    return CheckWarning(
        "teleport",
        f"the root jumps {counted(jumps.size, 'time')}; the fastest jump, at {speeds[fastest]:.0f} m/s, is from frame "
        f"{fastest} to {fastest + 1}",
        joints=clip.skeleton.joint_names[:1],
        frames=(int(jumps[0]), int(jumps[-1]) + 2),
        values={"speed_m_s": float(speeds[fastest]), "frame": fastest + 1, "count": int(jumps.size)},
    )


def _rotation_jumps(clip: Clip) -> CheckWarning | None:
    if clip.frame_count < 2 or _surely_no_jump(clip.rotations):
        return None
    cosines = _step_cosines(clip.rotations)
    angles = 2.0 * np.arccos(np.clip(cosines, 0.0, 1.0))
    jumps = angles > JUMP_RAD
    if not jumps.any():
        return None
    frames, joints = np.flatnonzero(jumps.any(axis=1)), np.flatnonzero(jumps.any(axis=0))
    frame, joint = np.unravel_index(int(angles.argmax()), angles.shape)
    worst = float(np.degrees(angles[frame, joint]))
    return CheckWarning(
        "rotation-jump",
        f"rotations of {counted(joints.size, 'joint')} jump, most of all {clip.skeleton.joint_names[joint]}: "
        f"by {worst:.0f}° from frame {frame} to {frame + 1}",
        joints=tuple(clip.skeleton.joint_names[joint] for joint in joints),
        frames=(int(frames[0]), int(frames[-1]) + 2),
        values={"angle_deg": worst, "frame": int(frame) + 1, "count": int(np.count_nonzero(jumps))},
    )


def _uneven_limbs(clip: Clip, tracks: Tracks) -> list[CheckWarning]:
    """Find a leg or an arm that is much shorter than that of the other side; bones that move have their mean offset."""
    landmarks, skeleton = tracks.body.landmarks, clip.skeleton
    if not landmarks.by_names:
        return []
    if clip.translations is not None:
        offsets = skeleton.offsets.copy()
        offsets[list(clip.translated_joints)] = clip.translations.mean(axis=0)
        skeleton = replace(skeleton, offsets=offsets)
    found = []
    for limb, pair in (("leg", landmarks.feet), ("arm", landmarks.hands)):
        if pair is None or (top := common_ancestor(skeleton.parents, pair)) in pair:
            continue
        left, right = (path_length(skeleton, top, end) for end in pair)
        if min(left, right) < UNEVEN * max(left, right):
            message = f"the left {limb} is {left:.2f} m long, and the right {limb} {right:.2f} m"
            names = tuple(skeleton.joint_names[end] for end in pair)
            found.append(CheckWarning("uneven-limbs", message, joints=names, values={"left_m": left, "right_m": right}))
    return found


def _dead_joints(clip: Clip, tracks: Tracks) -> CheckWarning | None:
    """Warn of limbs whose joints never turn while other joints do."""
    rotations, limbs = clip.rotations, tracks.body.limbs
    if clip.frame_count < 2 or not limbs:
        return None
    # One frame shows of nearly every limb that it turns.
    turned = (rotations[len(rotations) // 2] != rotations[0]).any(axis=1).tolist()
    still = [limb for limb in limbs if not any(turned[joint] for joint in limb)]
    dead = sorted(joint for limb in still if (rotations[:, limb] == rotations[0, limb]).all() for joint in limb)
    if not dead or (rotations == rotations[0]).all():
        return None
    names = tuple(clip.skeleton.joint_names[joint] for joint in dead)
    message = f"in at least one limb, no joint ever turns ({counted(len(names), 'joint')} in all)"
    return CheckWarning("dead-joints", message, joints=names)


def _surely_no_jump(rotations: NDArray[np.float32]) -> bool:
    """Return whether a quick check shows that no rotation from frame to frame is a jump.

    False means that the exact check must decide.
    """
    products = rotations[1:] * rotations[:-1]
    cosines = products[..., 0] + products[..., 1]
    cosines += products[..., 2]
    cosines += products[..., 3]
    return bool(np.abs(cosines, out=cosines).min() > _SURELY_NO_JUMP)


def _step_cosines(rotations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the cosine (F - 1, J) of half the angle between each joint's rotations in consecutive frames."""
    cosines: NDArray[np.float32] = np.abs(np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]))
    return cosines
