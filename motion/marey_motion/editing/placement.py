"""Commands that move, rotate, scale or mirror the whole body, and spread a correction of its path over frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.editing.borders import smooth_step
from marey_motion.editing.take import Take
from marey_motion.errors import EditError
from marey_motion.looping import LoopSeam, about_vertical
from marey_motion.mirroring import mirror_motion
from marey_motion.motion import Motion

GROUND = np.array([1.0, 0.0, 1.0])


def translate(take: Take, *, shift_m: Sequence[float]) -> Take:
    """Shift the motion.

    Parameters
    ----------
    take : Take    F frames
    shift_m : (3,)    metres

    Returns
    -------
    Take    F frames
    """
    motion = take.motion
    return take.moved(motion._replace(root_translations=motion.root_translations + np.asarray(shift_m)))


def rotate(
    take: Take,
    *,
    angle_rad: float,
    axis: Sequence[float] = (0.0, 1.0, 0.0),
    pivot: Literal["origin", "body"] = "origin",
) -> Take:
    """Rotate the motion about an axis of the world.

    Parameters
    ----------
    take : Take    F frames
    angle_rad : float    radians
    axis : (3,)    direction of the axis, of any length but zero
    pivot : str    "origin", or "body": the ground under the first frame

    Returns
    -------
    Take    F frames
    """
    turn = np.asarray(quaternions.from_axis_angle(axis, angle_rad), dtype=np.float64)
    place = np.zeros(3) if pivot == "origin" else body_at(take, 0)[0] * GROUND
    return take.moved(carried(take.motion, turn, place))


def face(take: Take, *, heading_rad: float = 0.0, frame: int = 0) -> Take:
    """Rotate the motion about the vertical through the body at a frame, so that it has a given heading there.

    Parameters
    ----------
    take : Take    F frames
    heading_rad : float    radians, 0 along +z, positive to the left
    frame : int    the frame

    Returns
    -------
    Take    F frames

    Raises
    ------
    MotionError    where the body has no facing direction in that frame, as when it lies on its side
    """
    place, heading = body_at(take, frame)
    return take.moved(carried(take.motion, about_vertical(np.asarray(heading_rad - heading)), place))


def move_to_origin(take: Take, *, frame: int = 0) -> Take:
    """Shift the motion on the ground, so that the pelvis is above the origin at a frame; heights stay.

    Parameters
    ----------
    take : Take    F frames
    frame : int    the frame

    Returns
    -------
    Take    F frames
    """
    return translate(take, shift_m=-pelvis_track(take, frame, frame + 1)[0] * GROUND)


def scale(take: Take, *, factor: float, translations: bool = False) -> Take:
    """Scale the path of the body about the origin, heights too.

    The skeleton is another item and does not change, so that the strides of a scaled path fit another body's legs.

    Parameters
    ----------
    take : Take    F frames
    factor : float    factor
    translations : bool    scale the translations of other joints, too

    Returns
    -------
    Take    F frames
    """
    motion = take.motion
    scaled = motion.translations.copy()
    carriers = take.skeleton.path_to_root(take.body.pelvis)
    chosen = [translations or joint in carriers for joint in motion.translated_joints]
    scaled[:, chosen] *= factor
    return take.moved(motion._replace(root_translations=motion.root_translations * factor, translations=scaled))


def flip_axes(take: Take, *, up: str = "+z", forward: str = "-y") -> Take:
    """Rotate the world so that one axis becomes +y and another +z.

    Only rotations: a world of the other hand is a mirror image, which `mirror` makes.

    Parameters
    ----------
    take : Take    F frames
    up : str    axis that becomes +y, one of +x to -z
    forward : str    axis that becomes +z

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    where both lie on one axis
    """
    y, z = _direction(up), _direction(forward)
    if np.any(np.abs(y + z) != np.abs(y) + np.abs(z)) or up[1] == forward[1]:
        raise EditError(f"up {up} and forward {forward} lie on one axis", where="forward")
    turn = quaternions.from_matrix(np.stack((np.cross(y, z), y, z)))
    return take.moved(carried(take.motion, np.asarray(turn, dtype=np.float64), np.zeros(3)))


def carried(motion: Motion, turns: Floats, pivots: Floats, shifts: Floats | None = None) -> Motion:
    """Rotate a motion about points, then shift it.

    Parameters
    ----------
    motion : Motion    F frames
    turns : (4,) or (F, 4) float64    rotations in the world
    pivots : (3,) or (F, 3) float64    metres
    shifts : (3,) or (F, 3) float64, optional    metres

    Returns
    -------
    Motion    F frames
    """
    arms = motion.root_translations - pivots
    places = pivots + quaternions.rotate_vectors(turns, arms)
    rotations = motion.rotations.copy()
    rotations[:, 0] = quaternions.multiply(turns, rotations[:, 0])
    return motion._replace(root_translations=places if shifts is None else places + shifts, rotations=rotations)


def moved_over(motion: Motion, seam: LoopSeam) -> Motion:
    """Rotate a motion about the origin and shift it on the ground.

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
    """Compute the positions of the pelvis.

    Parameters
    ----------
    take : Take    F frames
    start, stop : int    frames [start, stop)

    Returns
    -------
    (n, 3) float64    metres

    Raises
    ------
    EditError    where the frames do not exist
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
    heading : float    radians

    Raises
    ------
    MotionError    where the body has no facing direction
    """
    places, headings = body_track(take, frame, frame + 1)
    return places[0], float(headings[0])


def body_track(take: Take, start: int, stop: int) -> tuple[Floats, Floats]:
    """Compute the positions of the pelvis and the continuous headings of the body.

    Parameters
    ----------
    take : Take    F frames
    start, stop : int    frames [start, stop)

    Returns
    -------
    positions : (n, 3) float64    metres
    headings : (n,) float64    radians

    Raises
    ------
    MotionError    where the body has no facing direction
    """
    positions = _positions(take, start, stop)
    directions = kinematics.forward_directions(positions, take.body.matching.lefts, take.body.matching.rights)
    return positions[:, take.body.pelvis], kinematics.headings(directions)


def _positions(take: Take, start: int, stop: int) -> Floats:
    first, last = take.frames((start, stop))
    return take.motion.sliced(first, last).positions(take.skeleton)


def _direction(axis: str) -> Floats:
    """Make the unit vector of an axis such as -y."""
    if len(axis) != 2 or axis[0] not in "+-" or axis[1] not in "xyz":
        raise EditError(f"{axis!r} is not an axis; write it as in +z or -y", code="command-invalid")
    return np.asarray((-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[1])], dtype=np.float64)


def mirror(take: Take) -> Take:
    """Reflect the motion in x, by the skeleton's own pairs of joints, whatever their names and axes.

    Parameters
    ----------
    take : Take    F frames

    Returns
    -------
    Take    the mirrored copy
    """
    return take.moved(mirror_motion(take.skeleton, take.body.partners, take.motion))


def fix_drift(
    take: Take,
    *,
    shift_m: Sequence[float] = (0.0, 0.0, 0.0),
    turn_rad: float = 0.0,
    frames: tuple[int, int | None] | None = None,
    profile: Literal["linear", "smooth"] = "linear",
) -> Take:
    """Spread a shift and a turn about the vertical over a range: none of it in its first frame, all in its last.

    Within the range each frame turns about its own pelvis; the frames after it follow the last one rigidly.

    Parameters
    ----------
    take : Take    F frames
    shift_m : (3,)    metres
    turn_rad : float    radians, positive to the left
    frames : (int, int or None), optional    range, all when None
    profile : str    "linear" or "smooth"

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    where the frames do not exist or are only one
    """
    start, stop = take.frames(frames)
    if stop - start < 2:
        raise EditError(
            f"drift is spread over at least 2 frames; {start}:{stop} is one",
            code="frames-missing",
            where="frames",
        )
    places = np.clip((np.arange(take.frame_count) - start) / (stop - 1 - start), 0.0, 1.0)
    shares = places if profile == "linear" else smooth_step(places)
    pivots = pelvis_track(take, 0, take.frame_count)
    pivots[stop:] = pivots[stop - 1]
    turns = about_vertical(shares * turn_rad)
    return take.moved(carried(take.motion, turns, pivots, shares[:, None] * np.asarray(shift_m)))
