"""Commands that move, rotate, scale or mirror the whole body, or spread a correction of its path over frames."""

from __future__ import annotations

from math import radians

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.editing.borders import smooth_step
from marey_motion.editing.take import Take
from marey_motion.errors import EditError
from marey_motion.looping import LoopSeam, about_vertical
from marey_motion.mirroring import mirror_motion
from marey_motion.motion import Motion
from marey_schemas.editing.commands import (
    Face,
    FixDrift,
    FlipAxes,
    Mirror,
    MoveToOrigin,
    Rotate,
    Scale,
    SignedAxis,
    Translate,
)

GROUND = np.array([1.0, 0.0, 1.0])


def translate(take: Take, command: Translate) -> Take:
    """Shift the whole motion by a constant vector.

    Parameters
    ----------
    take : Take    F frames
    command : Translate    the shift along the axes of the world, metres

    Returns
    -------
    Take    F frames
    """
    return take.with_motion(shifted(take.motion, np.asarray(command.shift_m)))


def rotate(take: Take, command: Rotate) -> Take:
    """Rotate the whole motion about an axis, which is given in the world and passes through a pivot.

    Parameters
    ----------
    take : Take    F frames
    command : Rotate    angle, axis and pivot

    Returns
    -------
    Take    F frames
    """
    turn = np.asarray(quaternions.from_axis_angle(command.axis, radians(command.angle_deg)), dtype=np.float64)
    place = np.zeros(3) if command.pivot == "origin" else body_at(take, 0)[0] * GROUND
    return take.with_motion(carried(take.motion, turn, place))


def face(take: Take, command: Face) -> Take:
    """Rotate the motion about the vertical through the body, so that it has a given heading in a given frame.

    Parameters
    ----------
    take : Take    F frames
    command : Face    the heading and the frame

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    if the take lacks the frame
    MotionError    if the body has no facing direction in the frame, as when it lies on its side
    """
    place, heading = body_at(take, command.frame)
    turn = about_vertical(np.asarray(radians(command.heading_deg) - heading))
    return take.with_motion(carried(take.motion, turn, place))


def move_to_origin(take: Take, command: MoveToOrigin) -> Take:
    """Shift the motion on the ground, so that the pelvis is above the origin at a frame. Heights do not change.

    Parameters
    ----------
    take : Take    F frames
    command : MoveToOrigin    the frame

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    if the take lacks the frame
    """
    frame = command.frame
    return take.with_motion(shifted(take.motion, -pelvis_track(take, frame, frame + 1)[0] * GROUND))


def scale(take: Take, command: Scale) -> Take:
    """Scale the path of the body about the origin, including heights.

    The skeleton does not change, so a path can be scaled to fit the strides of a larger or smaller body.

    Parameters
    ----------
    take : Take    F frames
    command : Scale    the factor, and whether to scale also the translations of joints other than the
        pelvis and its ancestors

    Returns
    -------
    Take    F frames
    """
    motion = take.motion
    scaled = motion.translations.copy()
    carriers = take.skeleton.path_to_root(take.body.pelvis)
    chosen = [command.translations or joint in carriers for joint in motion.translated_joints]
    scaled[:, chosen] *= command.factor
    roots = motion.root_translations * command.factor
    return take.with_motion(motion._replace(root_translations=roots, translations=scaled))


def flip_axes(take: Take, command: FlipAxes) -> Take:
    """Rotate the world so that one axis becomes +y and another +z.

    Only rotations are allowed; a change of handedness is a reflection, see `mirror`.

    Parameters
    ----------
    take : Take    F frames
    command : FlipAxes    the axes that become +y and +z

    Returns
    -------
    Take    F frames
    """
    y, z = _direction(command.up), _direction(command.forward)
    turn = quaternions.from_matrix(np.stack((np.cross(y, z), y, z)))
    return take.with_motion(carried(take.motion, np.asarray(turn, dtype=np.float64), np.zeros(3)))


def carried(motion: Motion, turns: Floats, pivots: Floats, shifts: Floats | None = None) -> Motion:
    """Rotate a motion, as a whole or each frame by itself, about points, then shift it.

    Parameters
    ----------
    motion : Motion    F frames
    turns : (4,) or (F, 4) float64    rotations in the world
    pivots : (3,) or (F, 3) float64    points about which to rotate, metres
    shifts : (3,) or (F, 3) float64, optional    shifts after the rotation, metres

    Returns
    -------
    Motion    F frames
    """
    arms = motion.root_translations - pivots
    places = pivots + quaternions.rotate_vectors(turns, arms)
    rotations = motion.rotations.copy()
    rotations[:, 0] = quaternions.multiply(turns, rotations[:, 0])
    return motion._replace(root_translations=places if shifts is None else places + shifts, rotations=rotations)


def shifted(motion: Motion, shift: Floats) -> Motion:
    """Shift a whole motion by a constant vector in the world.

    Parameters
    ----------
    motion : Motion    F frames
    shift : (3,) float64    metres

    Returns
    -------
    Motion    F frames
    """
    return motion._replace(root_translations=motion.root_translations + shift)


def moved_over(motion: Motion, seam: LoopSeam) -> Motion:
    """Rotate a motion about the vertical through the origin, then shift it on the ground.

    Parameters
    ----------
    motion : Motion    F frames
    seam : LoopSeam    turn and shift

    Returns
    -------
    Motion    F frames
    """
    shift = np.array([seam.shift_m[0], 0.0, seam.shift_m[1]])
    return carried(motion, about_vertical(np.asarray(seam.turn_rad)), np.zeros(3), shift)


def pelvis_track(take: Take, start: int, stop: int) -> Floats:
    """Compute the positions of the pelvis in a range of frames.

    Parameters
    ----------
    take : Take    F frames
    start, stop : int    frames [start, stop)

    Returns
    -------
    (n, 3) float64    metres

    Raises
    ------
    EditError    if the take lacks one of the frames
    """
    return _positions(take, start, stop)[:, take.body.pelvis]


def body_at(take: Take, frame: int) -> tuple[Floats, float]:
    """Compute the position of the pelvis and the heading of the body at a frame.

    Parameters
    ----------
    take : Take    F frames
    frame : int    the frame

    Returns
    -------
    position : (3,) float64    metres
    heading : float    radians, 0 along +z, positive to the left

    Raises
    ------
    EditError    if the take lacks the frame
    MotionError    if the body has no facing direction
    """
    places, headings = body_track(take, frame, frame + 1)
    return places[0], float(headings[0])


def body_track(take: Take, start: int, stop: int) -> tuple[Floats, Floats]:
    """Compute the positions of the pelvis and the headings of the body in a range of frames.

    Parameters
    ----------
    take : Take    F frames
    start, stop : int    frames [start, stop)

    Returns
    -------
    positions : (n, 3) float64    metres
    headings : (n,) float64    radians, 0 along +z, positive to the left, without jumps by full turns

    Raises
    ------
    EditError    if the take lacks one of the frames
    MotionError    if the body has no facing direction
    """
    positions = _positions(take, start, stop)
    directions = kinematics.forward_directions(positions, take.body.matching.lefts, take.body.matching.rights)
    return positions[:, take.body.pelvis], kinematics.headings(directions)


def _positions(take: Take, start: int, stop: int) -> Floats:
    first, last = take.frames((start, stop))
    return take.motion.sliced(first, last).positions(take.skeleton)


def _direction(axis: SignedAxis) -> Floats:
    """Make the unit vector of an axis such as -y."""
    return np.asarray((-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[1])], dtype=np.float64)


def mirror(take: Take, _command: Mirror) -> Take:
    """Reflect the motion in x and exchange left and right joints, whatever the names and axes of the joints are.

    Parameters
    ----------
    take : Take    F frames
    _command : Mirror    has no parameters

    Returns
    -------
    Take    the mirrored copy
    """
    return take.with_motion(mirror_motion(take.skeleton, take.body.partners, take.motion))


def fix_drift(take: Take, command: FixDrift) -> Take:
    """Spread a shift and a turn about the vertical over a range: nothing in the first frame, everything in the last.

    Within the range, each frame turns about its own pelvis. The frames after the range move rigidly with the last frame
    of the range.

    Parameters
    ----------
    take : Take    F frames
    command : FixDrift    shift, turn, range and profile

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    if the take lacks one of the frames, or the range is a single frame
    """
    start, stop = take.frames(command.frames)
    if stop - start < 2:
        raise EditError(
            f"the range {start}:{stop} has only one frame; the drift must be spread over at least 2",
            code="frames-missing",
            where="frames",
        )
    places = np.clip((np.arange(take.frame_count) - start) / (stop - 1 - start), 0.0, 1.0)
    shares = places if command.profile == "linear" else smooth_step(places)
    pivots = pelvis_track(take, 0, take.frame_count)
    pivots[stop:] = pivots[stop - 1]
    turns = about_vertical(shares * radians(command.turn_deg))
    return take.with_motion(carried(take.motion, turns, pivots, shares[:, None] * np.asarray(command.shift_m)))
