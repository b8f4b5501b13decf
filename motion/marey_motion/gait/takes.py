"""Clips, and sets of clips, of generated gaits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import radians
from typing import NamedTuple

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait.body import SIDES, GaitMoments, padding_frames, pose_body
from marey_motion.gait.footfalls import Cadence, Footfalls, FootMotion, FootShape
from marey_motion.gait.path import PathSegment, RootPath, start_and_stop, straight_or_arc
from marey_motion.gait.skeletons import STUDIO_STATURE_M, studio_skeleton
from marey_motion.gait.style import GaitStyle
from marey_motion.skeleton import Skeleton

MAX_FRAMES = 1_000_000
BEHIND_ANKLE = 0.64  # distance of the heel behind the ankle, as a share of the ankle's height


class GeneratedTake(NamedTuple):
    """One clip of a generated set, with a name and tags to store it under."""

    name: str
    clip: Clip
    tags: tuple[str, ...]


def generate_gait(
    speed_m_s: float,
    turn_rate_rad_s: float,
    duration_s: float,
    frame_rate_hz: float = 60.0,
    *,
    travel_angle_rad: float = 0.0,
    stature_m: float = STUDIO_STATURE_M,
    style: GaitStyle | None = None,
) -> Clip:
    """Generate a walk, run, turn on the spot or idle motion; its root follows an exact arc from the origin, facing +Z.

    Parameters
    ----------
    speed_m_s : float    metres per second of the root over the ground
    turn_rate_rad_s : float    change of heading, radians per second; positive turns left
    duration_s : float    seconds; the clip has `duration_s` times `frame_rate_hz` frames, the first at time 0
    frame_rate_hz : float    frames per second
    travel_angle_rad : float    direction of travel relative to the heading: 0 forward, π/2 to the left, π backward
    stature_m : float    height of the `studio_skeleton` that moves, metres
    style : GaitStyle, optional    `GaitStyle.varied(seed)` for a random walker; neutral if None

    Returns
    -------
    Clip    motion of the studio skeleton, metres, Y up

    Raises
    ------
    MotionError    if a parameter is invalid (the message names it), or if a step would be longer than the leg

    Examples
    --------
    >>> from marey_motion import generate_gait
    >>> walk = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.5, duration_s=2.0, frame_rate_hz=30.0)
    >>> walk.frame_count, walk.skeleton.joint_count
    (60, 26)
    """
    path = straight_or_arc(speed_m_s, turn_rate_rad_s, duration_s, travel_angle_rad=travel_angle_rad)
    return generate_along(path, frame_rate_hz, stature_m=stature_m, style=style)


def generate_along(
    path: RootPath,
    frame_rate_hz: float = 60.0,
    *,
    stature_m: float = STUDIO_STATURE_M,
    style: GaitStyle | None = None,
) -> Clip:
    """Generate a gait whose root follows a path exactly.

    At frame n the root has the position and heading of `path` after n / `frame_rate_hz` seconds. Planted feet do not
    slide and nothing is below the floor y = 0. The same arguments give the same bytes.

    Parameters
    ----------
    path : RootPath    the path of the root
    frame_rate_hz : float    frames per second
    stature_m : float    height of the `studio_skeleton` that moves, metres
    style : GaitStyle, optional    `GaitStyle.varied(seed)` for a random walker; neutral if None

    Returns
    -------
    Clip    motion of the studio skeleton, metres, Y up

    Raises
    ------
    MotionError    if a parameter is invalid (the message names it), or if a step would be longer than the leg
    """
    skeleton, style = studio_skeleton(stature_m), style or GaitStyle()
    frames = _frame_count(path, frame_rate_hz)
    padding = padding_frames(frame_rate_hz)
    size = stature_m / STUDIO_STATURE_M
    path, times = _at_studio_size(path, np.arange(-padding, frames + padding) / frame_rate_hz, size)
    moments = GaitMoments(times, Cadence(path, style).phase_at(times), path.at(times))
    positions, rotations = pose_body(studio_skeleton(), style, moments, _feet(path, style, times))
    wanted = slice(padding, padding + frames)
    local = quaternions.unroll(kinematics.as_local_rotations(skeleton, rotations[wanted]))
    poses = np.concatenate((size * positions[wanted], local.reshape(frames, -1)), axis=1)
    return Clip(skeleton, frame_rate_hz, poses.astype(np.float32))


def foot_motions(
    path: RootPath, times_s: AnyFloats, *, stature_m: float = STUDIO_STATURE_M, style: GaitStyle | None = None
) -> dict[str, FootMotion]:
    """Compute the motion of both feet of `generate_along`, as ground truth for contacts.

    The clip of `generate_along` differs from this motion where a leg is too short to reach a swinging foot: there, the
    foot is moved towards the hip.

    Parameters
    ----------
    path : RootPath    the path of the root
    times_s : (n,)    increasing seconds
    stature_m : float    height of the walker, metres
    style : GaitStyle, optional    style of the walker; neutral if None

    Returns
    -------
    dict of str to FootMotion    by "Left" and "Right"
    """
    size = stature_m / STUDIO_STATURE_M
    path, times = _at_studio_size(path, times_s, size)
    feet = _feet(path, style or GaitStyle(), times)
    return {side: replace(foot, balls=size * foot.balls) for side, foot in feet.items()}


def _at_studio_size(path: RootPath, times_s: AnyFloats, size: float) -> tuple[RootPath, AnyFloats]:
    """Scale a walker's path and times to the studio skeleton; the walker is `size` times as tall as this skeleton.

    Bodies of all sizes move alike if times scale with the square root of lengths (equal Froude numbers, Alexander and
    Jayes 1983).
    """
    return path.rescaled(length=1.0 / size, time=size**-0.5), times_s * size**-0.5


def _feet(path: RootPath, style: GaitStyle, times_s: AnyFloats) -> dict[str, FootMotion]:
    cadence, shape = Cadence(path, style), _foot_shape(studio_skeleton())
    span_s = (float(times_s[0]), float(times_s[-1]))
    return {side: Footfalls(cadence, shape, sign, span_s).at(times_s) for side, sign in SIDES.items()}


def generate_dataset(seed: int = 0, frame_rate_hz: float = 60.0) -> list[GeneratedTake]:
    """Generate twenty-four takes of walks, runs, turns, side steps, starts and stops.

    Each take has a walker with a different style, so that two takes at the same speed never look the same.

    Parameters
    ----------
    seed : int    the same seed gives the same takes
    frame_rate_hz : float    frames per second

    Returns
    -------
    list of GeneratedTake    clips with names and tags

    Examples
    --------
    >>> from marey_motion import generate_dataset
    >>> takes = generate_dataset(seed=1, frame_rate_hz=30.0)
    >>> len(takes), takes[0].name, takes[0].tags
    (24, 'idle', ('idle',))
    """
    takes = []
    for number, (name, path, tags) in enumerate(_programme()):
        style = GaitStyle.varied(1000 * seed + number)
        takes.append(GeneratedTake(name, generate_along(path, frame_rate_hz, style=style), tags))
    return takes


def _programme() -> list[tuple[str, RootPath, tuple[str, ...]]]:
    """List names, paths and tags of the clips of the generated set."""

    def arc(speed: float, turn_deg: float = 0.0, travel_deg: float = 0.0, seconds: float = 6.0) -> RootPath:
        return straight_or_arc(speed, radians(turn_deg), seconds, travel_angle_rad=radians(travel_deg))

    return [
        ("idle", arc(0.0), ("idle",)),
        ("walk-slow", arc(0.8), ("walk", "straight")),
        ("walk-normal", arc(1.35), ("walk", "straight")),
        ("walk-fast", arc(1.8), ("walk", "straight")),
        ("run-slow", arc(2.6), ("run", "straight")),
        ("run-normal", arc(3.6), ("run", "straight")),
        ("run-fast", arc(5.5), ("run", "straight")),
        ("walk-turn-left-wide", arc(1.3, 25), ("walk", "turn", "left")),
        ("walk-turn-right-wide", arc(1.3, -25), ("walk", "turn", "right")),
        ("walk-turn-left", arc(1.2, 50), ("walk", "turn", "left")),
        ("walk-turn-right", arc(1.2, -50), ("walk", "turn", "right")),
        ("walk-turn-left-tight", arc(0.9, 100), ("walk", "turn", "left")),
        ("walk-turn-right-tight", arc(0.9, -100), ("walk", "turn", "right")),
        ("run-turn-left", arc(3.2, 45), ("run", "turn", "left")),
        ("run-turn-right", arc(3.2, -45), ("run", "turn", "right")),
        ("turn-on-the-spot-left", arc(0.0, 60), ("turn", "left")),
        ("turn-on-the-spot-right", arc(0.0, -60), ("turn", "right")),
        ("walk-backward", arc(0.9, 0, 180), ("walk", "backward")),
        ("side-step-left", arc(0.6, 0, 90), ("walk", "side", "left")),
        ("side-step-right", arc(0.6, 0, -90), ("walk", "side", "right")),
        ("walk-start-stop", start_and_stop(1.35, wait_s=1.0, ramp_s=1.0, cruise_s=4.0), ("walk", "start", "stop")),
        ("run-start-stop", start_and_stop(3.4, wait_s=1.0, ramp_s=1.5, cruise_s=3.0), ("run", "start", "stop")),
        ("walk-slalom", _slalom(1.3, radians(60), 1.5, 4), ("walk", "turn")),
        ("run-slalom", _slalom(3.0, radians(50), 1.2, 4), ("run", "turn")),
    ]


def _slalom(speed_m_s: float, turn_rate_rad_s: float, bend_s: float, bends: int) -> RootPath:
    """Make a path of `bends` bends to alternating sides, each of `bend_s` seconds.

    Half a bend is added before and after these bends, so that the path ends with the initial heading.
    """
    durations: Sequence[float] = [0.5 * bend_s, *[bend_s] * bends, 0.5 * bend_s]
    return RootPath(
        tuple(
            PathSegment(duration, speed_m_s, turn_rate_rad_s * (-1) ** number)
            for number, duration in enumerate(durations)
        )
    )


def _frame_count(path: RootPath, frame_rate_hz: float) -> int:
    if not (np.isfinite(frame_rate_hz) and frame_rate_hz > 0):
        raise MotionError(
            f"the frame rate must be a positive number, not {frame_rate_hz}", code="gait-invalid", where="frame_rate_hz"
        )
    frames = round(path.duration_s * frame_rate_hz)
    if not 1 <= frames <= MAX_FRAMES:
        raise MotionError(
            f"a walk of {path.duration_s:g} s at {frame_rate_hz:g} Hz has {frames} frames; 1 to {MAX_FRAMES} "
            "are allowed",
            code="gait-invalid",
            where="duration_s",
        )
    return frames


def _foot_shape(skeleton: Skeleton) -> FootShape:
    """Measure the left foot in the rest pose; the right one mirrors it."""
    rest = skeleton.rest_global_positions
    hip, ankle, ball = (rest[skeleton.index_of(f"Left{joint}")] for joint in ("UpLeg", "Foot", "ToeBase"))
    tip = next(site.offset for site in skeleton.end_sites if site.joint == skeleton.index_of("LeftToeBase"))
    return FootShape(
        ball_height_m=float(ball[1]),
        heel_length_m=float(ball[2] - ankle[2] + BEHIND_ANKLE * ankle[1]),
        toe_length_m=float(tip[2]),
        ball_ahead_m=float(ball[2] - hip[2]),
        half_width_m=float(ball[0]),
        hip_height_m=float(hip[1]),
    )
