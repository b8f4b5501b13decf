"""Joint positions and their motion: forward kinematics, velocities, heading, contacts.

Coordinates are right-handed with Y up; units are metres, seconds and radians. Heading theta is about +Y: a body that
faces +z has heading 0 and its left at +x. The forward direction is (sin theta, cos theta) in (x, z), so an increasing
heading is a left turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.skeleton import Skeleton
from marey_schemas.options.contacts import TOE_SPEED_M_S

CONTACT_WINDOW_S = 0.1
# If the sideways axis is shorter than this on the ground, the body lies on its side and has no defined heading.
SHORTEST_LATERAL_M = 1e-3
_KEPT_CHAINS = 256


def global_positions(clip: Clip, *, end_sites: bool = False) -> NDArray[np.float32]:
    """Compute the positions of all joints of a clip in the world.

    Parameters
    ----------
    clip : Clip    F frames of J joints
    end_sites : bool    append the skeleton's E end sites

    Returns
    -------
    (F, J, 3) float32    metres, Y up; (F, J + E, 3) with end sites

    Examples
    --------
    >>> from marey_motion import generate_gait, global_positions
    >>> clip = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0)
    >>> global_positions(clip).shape
    (120, 26, 3)
    >>> global_positions(clip, end_sites=True).shape
    (120, 33, 3)
    """
    return forward_kinematics(
        clip.skeleton,
        clip.poses,
        translations=clip.translations,
        translated_joints=clip.translated_joints,
        end_sites=end_sites,
    )


def global_rotations(clip: Clip) -> NDArray[np.float32]:
    """Compute the rotations of all joints of a clip in the world.

    Parameters
    ----------
    clip : Clip    F frames of J joints

    Returns
    -------
    (F, J, 4) float32    unit quaternions (w, x, y, z)

    Examples
    --------
    >>> from marey_motion import generate_gait, global_rotations
    >>> global_rotations(generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0)).shape
    (120, 26, 4)
    """
    return as_global_rotations(clip.skeleton, clip.rotations)


def forward_kinematics(
    skeleton: Skeleton,
    poses: AnyFloats,
    *,
    translations: AnyFloats | None = None,
    translated_joints: Sequence[int] = (),
    end_sites: bool = False,
) -> AnyFloats:
    """Compute joint positions in the world for poses that need not belong to a clip.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    poses : (F, 3 + 4·J) float32 or float64    root translation in metres, then unit local rotations (w, x, y, z)
    translations : (F, k, 3), optional    metres in the parent's frame, in place of the offsets of `translated_joints`
    translated_joints : sequence of int    indices of those k joints
    end_sites : bool    append the skeleton's E end sites as points J to J + E - 1

    Returns
    -------
    (F, J, 3) or (F, J + E, 3)    metres, in the type of `poses`

    Raises
    ------
    MotionError    if `poses` has another shape

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import forward_kinematics, studio_skeleton
    >>> skeleton = studio_skeleton()
    >>> rest = np.concatenate((skeleton.offsets[0], skeleton.rest_rotations.ravel()))[None]
    >>> np.allclose(forward_kinematics(skeleton, rest)[0], skeleton.rest_global_positions)
    True
    """
    from marey_motion import kinematics_kernels

    joints = skeleton.joint_count
    if poses.ndim != 2 or poses.shape[1] != 3 + 4 * joints:
        raise MotionError(
            f"the poses have shape {poses.shape}; this skeleton needs (frames, {3 + 4 * joints})", where="poses"
        )
    table = _chain(skeleton, poses.dtype, end_sites)
    points = len(table.parents)
    slots = table.no_slots
    if translated_joints:
        slots = slots.copy()
        slots[list(translated_joints)] = np.arange(len(translated_joints), dtype=np.int32)
    if translations is None:
        translations = np.empty((0, 0, 3), dtype=poses.dtype)
    out = np.empty((len(poses), 3 * points), dtype=poses.dtype)
    kinematics_kernels.positions(
        as_kernel_input(poses),
        table.offsets,
        table.parents,
        as_kernel_input(translations),
        slots,
        table.turned,
        out,
    )
    return out.reshape(len(poses), points, 3)


class _Chain(NamedTuple):
    """Arguments of `kinematics_kernels.positions` that depend only on the skeleton.

    Points are the joints, then the end sites. `no_slots` (points,) contains only -1; it is passed as `slots` if no
    translation replaces the offset of a point. `turned` (joints,) is True for joints with children.
    """

    offsets: AnyFloats
    parents: NDArray[np.int32]
    no_slots: NDArray[np.int32]
    turned: NDArray[np.bool_]


@lru_cache(maxsize=_KEPT_CHAINS)
def _chain(skeleton: Skeleton, dtype: np.dtype[np.floating[Any]], end_sites: bool) -> _Chain:
    sites = skeleton.end_sites if end_sites else ()
    parents, offsets = skeleton.parents, skeleton.offsets.astype(dtype)
    if sites:
        parents = np.concatenate((parents, np.array([site.joint for site in sites], dtype=np.int32)))
        offsets = np.concatenate((offsets, np.array([site.offset for site in sites], dtype=dtype)))
    turned = np.zeros(skeleton.joint_count, dtype=np.bool_)
    turned[parents[1:]] = True
    return _Chain(as_kernel_input(offsets), as_kernel_input(parents), np.full(len(parents), -1, dtype=np.int32), turned)


def as_global_rotations(skeleton: Skeleton, rotations: AnyFloats) -> AnyFloats:
    """Convert local rotations to rotations in the world.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    rotations : (F, J, 4)    unit quaternions in the parent's frame

    Returns
    -------
    (F, J, 4)    unit quaternions in the world, in the same type

    Raises
    ------
    MotionError    if `rotations` has another shape
    """
    from marey_motion import kinematics_kernels

    if rotations.ndim != 3 or rotations.shape[1:] != (skeleton.joint_count, 4):
        raise MotionError(
            f"the rotations have shape {rotations.shape}; this skeleton needs (frames, {skeleton.joint_count}, 4)",
            where="rotations",
        )
    flat = rotations.reshape(len(rotations), -1)
    out = np.empty(flat.shape, dtype=rotations.dtype)
    kinematics_kernels.rotations(as_kernel_input(flat), as_kernel_input(skeleton.parents), out)
    return out.reshape(rotations.shape)


def as_kernel_input(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array contiguous and read-only, so that each kernel is compiled for one layout only.

    Parameters
    ----------
    array : ndarray    any shape and type

    Returns
    -------
    ndarray    a view if the layout fits, else a copy
    """
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


def as_local_rotations(skeleton: Skeleton, rotations: AnyFloats) -> AnyFloats:
    """Convert rotations in the world to local rotations.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    rotations : (..., J, 4)    unit quaternions in the world

    Returns
    -------
    (..., J, 4)    unit quaternions in the parent's frame
    """
    parents = rotations[..., skeleton.parents[1:], :]
    inner = quaternions.multiply(quaternions.conjugate(parents), rotations[..., 1:, :])
    return np.concatenate((rotations[..., :1, :], inner), axis=-2)


def velocities(positions: AnyFloats, frame_rate_hz: float) -> AnyFloats:
    """Differentiate over time by central differences, linearly extrapolated at both ends.

    Parameters
    ----------
    positions : (F, ...)    metres, or any other unit
    frame_rate_hz : float    frames per second

    Returns
    -------
    (F, ...)    metres per second, in the type of `positions`

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import velocities
    >>> velocities(np.array([0.0, 1.0, 4.0, 9.0]), frame_rate_hz=1.0)
    array([0., 2., 4., 6.])
    """
    steps = np.diff(np.asarray(positions, dtype=np.float64), axis=0) * frame_rate_hz
    return quaternions.rate_from_steps(steps, len(positions)).astype(positions.dtype, copy=False)


def ground_projection(positions: AnyFloats) -> AnyFloats:
    """Project positions to the ground.

    Parameters
    ----------
    positions : (..., 3)    metres, Y up

    Returns
    -------
    (..., 2)    (x, z) in metres
    """
    return positions[..., (0, 2)]


def forward_directions(positions: AnyFloats, left: Sequence[int], right: Sequence[int]) -> NDArray[np.float64]:
    """Compute the direction that the body faces on the ground.

    In each frame, the vectors from the right to the left joints are summed. The direction is the cross product of this
    sum and the upward direction. If the sum is vertical or nearly so, the frame has no direction of its own and gets
    the direction of the frame before. Frames before the first direction get the first direction.

    Parameters
    ----------
    positions : (F, J, 3)    metres, Y up
    left, right : sequence of int    matching joints of both sides, preferably the hips and the shoulders

    Returns
    -------
    (F, 2) float64    unit (x, z)

    Raises
    ------
    MotionError    if no frame has a direction

    Examples
    --------
    >>> from marey_motion import forward_directions, generate_gait, global_positions
    >>> clip = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0)
    >>> left, right = clip.skeleton.index_of("LeftUpLeg"), clip.skeleton.index_of("RightUpLeg")
    >>> forward_directions(global_positions(clip), [left], [right])[0].round(1) + 0.0
    array([0., 1.])
    """
    forward = forward_vectors(positions, left, right)
    length = np.linalg.norm(forward, axis=1)
    known = length >= SHORTEST_LATERAL_M
    if not known.any():
        raise MotionError(
            "the forward direction of the body cannot be computed, because in every frame the left joints are above, "
            "below or at the right joints; check the joint mapping, or choose frames in which the body is upright",
            code="heading-undefined",
        )
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    frames = np.where(last_known < 0, int(np.argmax(known)), last_known)
    directions: NDArray[np.float64] = forward[frames] / length[frames, None]
    return directions


def forward_vectors(positions: AnyFloats, left: Sequence[int], right: Sequence[int]) -> NDArray[np.float64]:
    """Compute the vectors that `forward_directions` scales to length 1.

    Parameters
    ----------
    positions : (F, J, 3)    metres, Y up
    left, right : sequence of int    matching joints of both sides

    Returns
    -------
    (F, 2) float64    (x, z) in metres; a length below `SHORTEST_LATERAL_M` gives no reliable direction

    Raises
    ------
    MotionError    if there are no joints, or not as many left as right ones
    """
    if not left or len(left) != len(right):
        raise MotionError(
            f"computing a heading needs as many left as right joints, at least one of each, not {len(left)} left and "
            f"{len(right)} right joints",
            code="heading-undefined",
        )
    lateral = np.sum(positions[:, list(left)].astype(np.float64) - positions[:, list(right)], axis=1)
    return np.stack((-lateral[:, 2], lateral[:, 0]), axis=1)


def headings(directions: AnyFloats) -> NDArray[np.float64]:
    """Compute headings from directions on the ground.

    Parameters
    ----------
    directions : (F, 2)    (x, z)

    Returns
    -------
    (F,) float64    radians about +Y, 0 along +z, continuous in time

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import headings
    >>> np.degrees(headings(np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]])))
    array([  0.,  90., 180.])
    """
    return np.unwrap(np.arctan2(directions[:, 0], directions[:, 1]).astype(np.float64))


def turn_rates(heading: AnyFloats, frame_rate_hz: float) -> NDArray[np.float64]:
    """Compute the turning speed from headings.

    Parameters
    ----------
    heading : (F,)    radians, continuous in time
    frame_rate_hz : float    frames per second

    Returns
    -------
    (F,) float64    radians per second, positive to the left

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import turn_rates
    >>> turn_rates(np.array([0.0, 0.1, 0.2]), frame_rate_hz=10.0).round(6)
    array([1., 1., 1.])
    """
    return np.asarray(velocities(heading, frame_rate_hz), dtype=np.float64)


def foot_contacts(
    toes: AnyFloats,
    frame_rate_hz: float,
    *,
    speed_limit_m_s: float = TOE_SPEED_M_S,
    window_s: float = CONTACT_WINDOW_S,
) -> NDArray[np.bool_]:
    """Detect which feet touch the ground.

    A toe slower than the limit counts as touching the ground. A majority filter over the largest odd number of frames
    that fits in the window then removes flicker of single frames.

    Parameters
    ----------
    toes : (F, k, 3)    positions of k toes in metres
    frame_rate_hz : float    frames per second
    speed_limit_m_s : float    speed limit of a standing toe, in metres per second
    window_s : float    duration of the filter's window, in seconds

    Returns
    -------
    (F, k) bool    True where the foot touches the ground

    Examples
    --------
    >>> from marey_motion import foot_contacts, generate_gait, global_positions
    >>> clip = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0)
    >>> toes = [clip.skeleton.index_of(name) for name in ("LeftToeBase", "RightToeBase")]
    >>> foot_contacts(global_positions(clip)[:, toes], clip.frame_rate_hz).shape
    (120, 2)
    """
    slow = np.linalg.norm(velocities(toes, frame_rate_hz), axis=-1) < speed_limit_m_s
    return without_flicker(slow, frame_rate_hz, window_s)


def without_flicker(flags: NDArray[np.bool_], frame_rate_hz: float, window_s: float) -> NDArray[np.bool_]:
    """Replace each flag by the majority of the flags around it.

    Parameters
    ----------
    flags : (F, k) bool    flags of F frames
    frame_rate_hz : float    frames per second
    window_s : float    duration of the window, in seconds: the largest odd number of frames that fits is used

    Returns
    -------
    (F, k) bool    the filtered flags; windows that extend beyond the ends contain copies of the first or last flag
    """
    reach = max(0, (int(window_s * frame_rate_hz + 1e-9) - 1) // 2)
    padded = np.pad(flags, ((reach + 1, reach), (0, 0)), mode="edge")
    padded[0] = False
    total = np.cumsum(padded, axis=0, dtype=np.int64)
    votes = total[2 * reach + 1 :] - total[: len(flags)]
    steady: NDArray[np.bool_] = 2 * votes > 2 * reach + 1
    return steady
