"""Poses of the studio skeleton from a root path and two feet: pelvis, legs, trunk and arms.

Local +X is the body's left, +Y up, +Z forward; in the skeleton's rest pose all joints have the world's axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.errors import MotionError
from marey_motion.gait import style as styles
from marey_motion.gait.footfalls import FootMotion, smooth_positive_part
from marey_motion.gait.path import RootState
from marey_motion.gait.style import GaitStyle, eased
from marey_motion.skeleton import Skeleton

LEG_STRETCH = 0.99  # greatest share of the length of the straight leg; a knee that locks would move with a jerk
YIELDING_M = 0.10  # range of a leg's length over which a foot in mid-air begins to follow the stretched leg
SMOOTHING_S = 0.12  # half of the window over which the pelvis is lowered for a leg that would be out of reach
BLENDING_S = 0.30  # half of the window over which trunk and arms follow a change of speed or turn
SIDES = {"Left": 1, "Right": -1}


@dataclass(frozen=True)
class GaitMoments:
    """Inputs of `pose_body` at n evenly spaced points in time.

    Parameters
    ----------
    times_s : (n,)    seconds
    phases : (n,)    strides done since time 0
    root : RootState    position, velocity and heading on the path, not smoothed
    """

    times_s: AnyFloats
    phases: AnyFloats
    root: RootState

    @property
    def frame_rate_hz(self) -> float:
        """Number of points in time per second."""
        return (len(self.times_s) - 1) / float(self.times_s[-1] - self.times_s[0])

    def smoothed(self, values: AnyFloats, window_s: float = BLENDING_S) -> AnyFloats:
        """Smooth values over time with a Hann window.

        Parameters
        ----------
        values : (n,)    any unit
        window_s : float    half of the window: seconds before and after each point in time

        Returns
        -------
        (n,)    averages, in the same unit
        """
        from scipy.ndimage import convolve1d  # imported here, because this import is slow

        reach = _reach(window_s, self.frame_rate_hz)
        weights = np.hanning(2 * reach + 3)[1:-1]
        return np.asarray(convolve1d(values, weights / weights.sum(), mode="nearest"))

    def smoothed_below(self, limits: AnyFloats, window_s: float = SMOOTHING_S) -> AnyFloats:
        """Compute a smooth curve that is nowhere above given limits.

        Each limit is first replaced by the least limit in a window around it. The result is then smoothed with a Hann
        window of the same width. The curve at a point in time is thus an average of minima over windows that all
        contain this point, so it does not exceed the limit there.

        Parameters
        ----------
        limits : (n,)    any unit
        window_s : float    half of both windows: seconds before and after each point in time

        Returns
        -------
        (n,)    the curve, in the same unit
        """
        from scipy.ndimage import minimum_filter1d

        lowest = minimum_filter1d(limits, 2 * _reach(window_s, self.frame_rate_hz) + 1, mode="nearest")
        return self.smoothed(lowest, window_s)


def _reach(window_s: float, frame_rate_hz: float) -> int:
    return round(window_s * frame_rate_hz)


def padding_frames(frame_rate_hz: float) -> int:
    """Compute how many frames to add before and after the requested ones, so that averages at the ends are complete.

    Parameters
    ----------
    frame_rate_hz : float    frames per second

    Returns
    -------
    int    number of frames
    """
    return 2 * _reach(BLENDING_S, frame_rate_hz) + 1


def pose_body(
    skeleton: Skeleton, style: GaitStyle, moments: GaitMoments, feet: Mapping[str, FootMotion]
) -> tuple[AnyFloats, AnyFloats]:
    """Pose the studio skeleton from a root path and two feet.

    Parameters
    ----------
    skeleton : Skeleton    the studio skeleton, J joints
    style : GaitStyle    style of the walker
    moments : GaitMoments    inputs at n points in time
    feet : mapping of str to FootMotion    motion of the "Left" and "Right" foot

    Returns
    -------
    positions : (n, 3)    root positions in metres, Y up
    rotations : (n, J, 4)    rotations of the joints in the world

    Raises
    ------
    MotionError    if a step is longer than the leg
    """
    root = moments.root
    rotations = {"Hips": _pelvis(style, moments)}
    ankles = {side: _ankle(skeleton, side, feet[side], rotations) for side in SIDES}
    loaded = {side: feet[side].heel_planted | feet[side].ball_planted for side in SIDES}
    heights = _pelvis_heights(skeleton, style, moments, rotations["Hips"], ankles, loaded)
    positions = np.stack((root.positions.imag, heights, root.positions.real), axis=-1)
    for side in SIDES:
        hip = positions + quaternions.rotate_vectors(rotations["Hips"], _offset(skeleton, side + "UpLeg"))
        facing = 0.5 * (root.headings + feet[side].yaws)
        _bend_leg(skeleton, side, hip, ankles[side], facing, feet[side].freedom, rotations)
    _pose_trunk(style, moments, rotations)
    for side, sign in SIDES.items():
        _pose_arm(style, moments, side, sign, rotations)
    return positions, np.stack([rotations[name] for name in skeleton.joint_names], axis=1)


def _offset(skeleton: Skeleton, name: str) -> NDArray[np.float64]:
    return np.asarray(skeleton.offsets[skeleton.index_of(name)])


def _thigh_m(skeleton: Skeleton) -> float:
    return -float(_offset(skeleton, "LeftLeg")[1])


def _shank_m(skeleton: Skeleton) -> float:
    return -float(_offset(skeleton, "LeftFoot")[1])


def _pelvis(style: GaitStyle, moments: GaitMoments) -> AnyFloats:
    """Rotate the pelvis to the heading, with a tilt that drops the side of the swinging leg."""
    speeds = moments.smoothed(moments.root.speeds)
    tilts = style.bounce * 0.06 * eased(speeds / 1.4) * np.cos(2.0 * np.pi * moments.phases)
    return quaternions.from_euler("yz", np.stack((moments.root.headings, tilts), axis=-1))


def _ankle(skeleton: Skeleton, side: str, foot: FootMotion, rotations: dict[str, AnyFloats]) -> AnyFloats:
    """Compute the position (n, 3) of the ankle, and add the rotations of foot and toes to `rotations`."""
    name, toes = side + "Foot", side + "ToeBase"
    rotations[name] = quaternions.from_euler("yx", np.stack((foot.yaws, -foot.pitches), axis=-1))
    rotations[toes] = quaternions.from_euler("yx", np.stack((foot.yaws, -foot.toe_pitches), axis=-1))
    return foot.balls - quaternions.rotate_vectors(rotations[name], _offset(skeleton, toes))


def _pelvis_heights(
    skeleton: Skeleton,
    style: GaitStyle,
    moments: GaitMoments,
    pelvis: AnyFloats,
    ankles: Mapping[str, AnyFloats],
    loaded: Mapping[str, NDArray[np.bool_]],
) -> AnyFloats:
    """Compute heights (n,) of the root: the gait's rise and fall, lowered where a leg would not reach its loaded foot.

    `pelvis` (n, 4) are rotations of the pelvis. For each side, `ankles` has positions (n, 3), and `loaded` has flags
    (n,) that are True while the foot is on the ground.
    """
    speeds = moments.smoothed(moments.root.speeds)
    leg = _thigh_m(skeleton) + _shank_m(skeleton)
    moving = eased(speeds / 1.2)
    crouch = 0.006 + moving * styles.blended(0.010, 0.045, speeds)
    rise = style.bounce * moving * styles.blended(0.014, -0.035, speeds) * np.cos(4.0 * np.pi * moments.phases)
    heights = skeleton.offsets[0, 1] + leg * (rise - crouch)
    for side, ankle in ankles.items():
        hip = quaternions.rotate_vectors(pelvis, _offset(skeleton, side + "UpLeg"))
        across = moments.root.positions + hip[:, 2] + 1j * hip[:, 0] - (ankle[:, 2] + 1j * ankle[:, 0])
        squared = np.where(loaded[side], (LEG_STRETCH * leg) ** 2 - np.abs(across) ** 2, np.inf)
        if squared.min() <= 0.0:
            moment = moments.times_s[np.argmin(squared)]
            raise MotionError(
                f"at {moment:.2f} s, a step would be longer than the leg of {leg:.2f} m; use a slower speed "
                "or a lower turn rate",
                code="gait-out-of-reach",
                where="speed_m_s",
            )
        heights = np.minimum(heights, ankle[:, 1] + np.sqrt(squared) - hip[:, 1])
    return moments.smoothed_below(heights)


def _bend_leg(
    skeleton: Skeleton,
    side: str,
    hip: AnyFloats,
    ankle: AnyFloats,
    facing: AnyFloats,
    freedom: AnyFloats,
    rotations: dict[str, AnyFloats],
) -> None:
    """Solve a leg by two-bone inverse kinematics; the knee bends towards the heading `facing` (n,), in radians.

    The heading `facing` lies between the headings of pelvis and foot. An ankle that is out of reach is moved towards
    the hip until the leg reaches it. The greater `freedom` (n,) is, the earlier and the more gradually this movement
    begins.
    """
    thigh, shank = _thigh_m(skeleton), _shank_m(skeleton)
    reach = ankle - hip
    distance = np.linalg.norm(reach, axis=-1, keepdims=True)
    along = reach / distance
    slack = LEG_STRETCH * (thigh + shank) - distance
    distance = distance + slack - smooth_positive_part(slack, YIELDING_M * freedom[:, None])
    ankle = hip + distance * along
    ahead = np.stack((np.sin(facing), np.zeros_like(facing), np.cos(facing)), axis=-1)
    bend = quaternions.perpendicular(ahead, along)
    cosine = np.clip((thigh**2 + distance**2 - shank**2) / (2.0 * thigh * distance), -1.0, 1.0)
    knee = hip + thigh * (cosine * along + np.sqrt(1.0 - cosine**2) * bend)
    hinge = np.cross(bend, along)
    for joint, start, end in ((side + "UpLeg", hip, knee), (side + "Leg", knee, ankle)):
        y = (start - end) / np.linalg.norm(start - end, axis=-1, keepdims=True)
        rotations[joint] = quaternions.from_matrix(np.stack((hinge, y, np.cross(hinge, y)), axis=-1))


def _pose_trunk(style: GaitStyle, moments: GaitMoments, rotations: dict[str, AnyFloats]) -> None:
    """Pose trunk, neck and head, and add their rotations in the world to `rotations`.

    The trunk leans forward or backward with the speed in this direction, and to the inner side of turns. The shoulders
    turn against the legs, and the head faces ahead.
    """
    root = moments.root
    forward = moments.smoothed(root.speeds * np.cos(root.travel_angles))
    bank = style.lean * moments.smoothed(styles.bank_rad(root.speeds, root.turn_rates))
    lean = (
        style.lean
        * np.sign(forward)
        * styles.blended(
            0.03 * eased(np.abs(forward)), np.minimum(0.10 + 0.025 * np.abs(forward), 0.30), np.abs(forward)
        )
    )
    twist = _shoulder_twist(style, moments)
    slow = style.wander * np.array([_drift(style, moments, which) for which in range(3)])
    for name, share in (("Spine", 0.33), ("Spine1", 0.67), ("Spine2", 1.0)):
        rotations[name] = _turned("yzx", root.headings + share * twist, -share * bank, share * (lean + 0.02 * slow[1]))
    rotations["Neck"] = _turned("yzx", root.headings + 0.3 * twist + 0.05 * slow[0], -0.6 * bank, 0.5 * lean)
    rotations["Head"] = _turned("yzx", root.headings + 0.15 * slow[0], -0.3 * bank, 0.2 * lean + 0.06 * slow[2])


def _pose_arm(style: GaitStyle, moments: GaitMoments, side: str, sign: int, rotations: dict[str, AnyFloats]) -> None:
    """Pose an arm that swings opposite to the leg of its side; at higher speeds, the elbow is bent more."""
    speeds = moments.smoothed(moments.root.speeds)
    swing = style.arm_swing * sign * np.sin(2.0 * np.pi * moments.phases)
    angle = swing * styles.blended(0.38 * eased(speeds / 1.4), 0.55, speeds) - styles.blended(0.04, 0.10, speeds)
    drift = style.wander * _drift(style, moments, 1 + (sign > 0))
    aside = 0.16 + styles.blended(0.0, 0.10, speeds) + 0.04 * drift
    inward = styles.blended(0.15, 0.35, speeds)
    bend = styles.blended(0.25 + 0.15 * swing * eased(speeds / 1.4), 1.45 + 0.25 * swing, speeds) + 0.05 * drift
    rotations[side + "Shoulder"] = rotations["Spine2"]
    yaw = moments.root.headings + _shoulder_twist(style, moments)
    rotations[side + "Arm"] = _turned("yxyz", yaw, -angle, -sign * inward, -sign * (0.5 * np.pi - aside))
    rotations[side + "ForeArm"] = quaternions.multiply(rotations[side + "Arm"], _turned("y", -sign * bend))
    rotations[side + "Hand"] = rotations[side + "HandThumb1"] = rotations[side + "ForeArm"]
    curl = np.full_like(bend, -sign * 0.35)
    rotations[side + "HandMiddle1"] = quaternions.multiply(rotations[side + "Hand"], _turned("z", curl))


def _shoulder_twist(style: GaitStyle, moments: GaitMoments) -> AnyFloats:
    speeds = moments.smoothed(moments.root.speeds)
    size = styles.blended(0.10 * eased(speeds / 1.4), 0.14, speeds)
    return np.asarray(-style.sway * size * np.sin(2.0 * np.pi * moments.phases))


def _drift(style: GaitStyle, moments: GaitMoments, which: int) -> AnyFloats:
    """Compute one of three slow sine waves (n,), chosen by `which`; each has its own period and phase."""
    period_s = (9.1, 6.7, 4.9)[which]
    return np.asarray(np.sin(2.0 * np.pi * moments.times_s / period_s + style.wander_phases_rad[which]))


def _turned(axes: str, *angles: AnyFloats) -> AnyFloats:
    """Compute intrinsic rotations (n, 4) about the axes that `axes` lists, such as "yzx"; angles (n,) in radians."""
    result: AnyFloats = quaternions.identity()
    for axis, angle in zip(axes, angles, strict=True):
        result = quaternions.multiply(result, quaternions.from_axis_angle(np.eye(3)["xyz".index(axis)], angle))
    return result
