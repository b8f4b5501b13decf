"""Where joints are and how they move: forward kinematics, velocities, heading, contacts.

Right-handed, Y up, metres, seconds, radians. Heading theta is about +Y: a body that faces +z has heading 0 and its left
at +x, forward(theta) = (sin theta, cos theta) in (x, z), and a growing heading is a left turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.skeleton import Skeleton

CONTACT_SPEED_M_S = 0.15
CONTACT_WINDOW_S = 0.1
# A sideways axis shorter than this on the ground belongs to a body lying on its side and says nothing of its heading.
SHORTEST_LATERAL_M = 1e-3


def global_positions(clip: Clip, *, end_sites: bool = False) -> NDArray[np.float32]:
    """Positions (F, J, 3) of all joints of a clip in metres; `end_sites` appends them: (F, J + E, 3)."""
    return forward_kinematics(
        clip.skeleton,
        clip.poses,
        translations=clip.translations,
        translated_joints=clip.translated_joints,
        end_sites=end_sites,
    )


def global_rotations(clip: Clip) -> NDArray[np.float32]:
    """Rotations (F, J, 4) of all joints of a clip in the world."""
    return as_global_rotations(clip.skeleton, clip.rotations)


def forward_kinematics(
    skeleton: Skeleton,
    poses: AnyFloats,
    *,
    translations: AnyFloats | None = None,
    translated_joints: Sequence[int] = (),
    end_sites: bool = False,
) -> AnyFloats:
    """Global joint positions (F, J, 3), in metres and the type of `poses`, of poses that need not belong to a clip.

    Parameters
    ----------
    poses : (F, 3 + 4·J) float32 or float64    root translation, then unit local rotations
    translations : (F, k, 3)    metres, in place of the offsets of the k `translated_joints`
    end_sites : append the skeleton's E end sites as points J to J + E - 1
    """
    from marey_motion import kinematics_kernels

    joints = skeleton.joint_count
    if poses.ndim != 2 or poses.shape[1] != 3 + 4 * joints:
        raise MotionError(f"shape {poses.shape} where (frames, {3 + 4 * joints}) is needed", where="poses")
    sites = skeleton.end_sites if end_sites else ()
    parents = np.array([*skeleton.parents, *(site.joint for site in sites)], dtype=np.int32)
    offsets = np.array([*skeleton.offsets, *(site.offset for site in sites)], dtype=poses.dtype)
    points = len(parents)
    slots = np.full(points, -1, dtype=np.int32)
    slots[list(translated_joints)] = np.arange(len(translated_joints), dtype=np.int32)
    if translations is None:
        translations = np.empty((0, 0, 3), dtype=poses.dtype)
    turned = np.zeros(joints, dtype=np.bool_)
    turned[parents[1:]] = True  # a leaf's own rotation moves nothing
    out = np.empty((len(poses), 3 * points), dtype=poses.dtype)
    kinematics_kernels.positions(
        as_kernel_input(poses),
        as_kernel_input(offsets),
        as_kernel_input(parents),
        as_kernel_input(translations),
        slots,
        turned,
        out,
    )
    return out.reshape(len(poses), points, 3)


def as_global_rotations(skeleton: Skeleton, rotations: AnyFloats) -> AnyFloats:
    """Global rotations (F, J, 4) of local ones (F, J, 4)."""
    from marey_motion import kinematics_kernels

    if rotations.ndim != 3 or rotations.shape[1:] != (skeleton.joint_count, 4):
        raise MotionError(
            f"shape {rotations.shape} where (frames, {skeleton.joint_count}, 4) is needed", where="rotations"
        )
    flat = rotations.reshape(len(rotations), -1)
    out = np.empty(flat.shape, dtype=rotations.dtype)
    kinematics_kernels.rotations(as_kernel_input(flat), as_kernel_input(skeleton.parents), out)
    return out.reshape(rotations.shape)


def as_kernel_input(array: NDArray[Any]) -> NDArray[Any]:
    """The array contiguous and read-only, so that each kernel is compiled for one layout only."""
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


def as_local_rotations(skeleton: Skeleton, rotations: AnyFloats) -> AnyFloats:
    """Local rotations (..., J, 4) of global ones (..., J, 4)."""
    parents = rotations[..., skeleton.parents[1:], :]
    inner = quaternions.multiply(quaternions.conjugate(parents), rotations[..., 1:, :])
    return np.concatenate((rotations[..., :1, :], inner), axis=-2)


def velocities(positions: AnyFloats, frame_rate_hz: float) -> AnyFloats:
    """Velocities (F, ...) in m/s of positions (F, ...): central differences, linearly extrapolated at both ends."""
    steps = np.diff(np.asarray(positions, dtype=np.float64), axis=0) * frame_rate_hz
    return quaternions.rate_from_steps(steps, len(positions)).astype(positions.dtype, copy=False)


def ground_projection(positions: AnyFloats) -> AnyFloats:
    """The (x, z) part (..., 2) of positions (..., 3)."""
    return positions[..., (0, 2)]


def forward_directions(positions: AnyFloats, left: Sequence[int], right: Sequence[int]) -> NDArray[np.float64]:
    """Where the body faces on the ground: unit (x, z) directions (F, 2).

    Parameters
    ----------
    positions : (F, J, 3)    metres
    left, right : matching joints of both sides, best the hips and the shoulders

    The sum of the left-minus-right vectors crossed with up. Frames in which that axis is vertical take the direction of
    the frame before them (the first ones, of the first frame that has one); `MotionError` when no frame has one.
    """
    forward = forward_vectors(positions, left, right)
    length = np.linalg.norm(forward, axis=1)
    known = length >= SHORTEST_LATERAL_M
    if not known.any():
        raise MotionError("left and right joints are never apart on the ground", code="heading-undefined")
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    frames = np.where(last_known < 0, int(np.argmax(known)), last_known)
    directions: NDArray[np.float64] = forward[frames] / length[frames, None]
    return directions


def forward_vectors(positions: AnyFloats, left: Sequence[int], right: Sequence[int]) -> NDArray[np.float64]:
    """As `forward_directions`, not brought to length 1 (F, 2): one under `SHORTEST_LATERAL_M` tells no direction."""
    if not left or len(left) != len(right):
        raise MotionError("a heading needs at least one pair of left and right joints", code="heading-undefined")
    lateral = np.sum(positions[:, list(left)].astype(np.float64) - positions[:, list(right)], axis=1)
    return np.stack((-lateral[:, 2], lateral[:, 0]), axis=1)


def headings(directions: AnyFloats) -> NDArray[np.float64]:
    """Heading theta (F,) in radians, continuous in time, of directions (F, 2) on the ground."""
    return np.unwrap(np.arctan2(directions[:, 0], directions[:, 1]).astype(np.float64))


def turn_rates(heading: AnyFloats, frame_rate_hz: float) -> NDArray[np.float64]:
    """Turning speed omega (F,) in rad/s, positive to the left, of continuous headings (F,)."""
    return np.asarray(velocities(heading, frame_rate_hz), dtype=np.float64)


def foot_contacts(
    toes: AnyFloats,
    frame_rate_hz: float,
    *,
    speed_limit_m_s: float = CONTACT_SPEED_M_S,
    window_s: float = CONTACT_WINDOW_S,
) -> NDArray[np.bool_]:
    """Whether feet stand (F, k), from toe positions (F, k, 3) in metres.

    A toe slower than the limit touches the ground; then each frame follows the majority of the frames around it, within
    the largest odd number that fits in the window, so that single frames cannot flicker.
    """
    slow = np.linalg.norm(velocities(toes, frame_rate_hz), axis=-1) < speed_limit_m_s
    reach = max(0, (int(window_s * frame_rate_hz + 1e-9) - 1) // 2)
    padded = np.pad(slow, ((reach + 1, reach), (0, 0)), mode="edge")
    padded[0] = False
    total = np.cumsum(padded, axis=0, dtype=np.int64)
    votes = total[2 * reach + 1 :] - total[: len(slow)]
    standing: NDArray[np.bool_] = 2 * votes > 2 * reach + 1
    return standing
