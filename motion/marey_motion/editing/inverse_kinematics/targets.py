"""Inputs of inverse kinematics: targets of joints, limits of joints, and the joints that may turn.

Coordinates are right-handed with Y up, in metres; angles are in radians, and quaternions are (w, x, y, z). Targets are
in the world, offsets and limits in a joint's own frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from marey_motion import quaternions
from marey_motion.arrays import Floats, Ints
from marey_motion.errors import EditError
from marey_motion.rigs import JointAxes
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import Axes

ANGLE_LENGTH_M = 0.01 / math.radians(5.0)
"""Weight of angles relative to positions, in metres per radian: an error of five degrees counts as one centimetre."""


@dataclass(frozen=True, eq=False)
class PositionTarget:
    """Target position of a point of a joint.

    Parameters
    ----------
    joint : index of the joint
    position : (3,), or (F, 3) for each frame    metres, world
    axes : coordinates that must match, such as "xz"; all other coordinates are free
    offset : (3,) metres in the joint's frame, from the joint to the point, such as the tip of a tool
    weight : weight of the squared distance
    pole : (3,) metres, world; point to which the elbow or knee of the limb that ends at the joint is directed (two-bone
        solver only, and only with `Neighbours`)
    """

    joint: int
    position: ArrayLike
    axes: Axes = "xyz"
    offset: ArrayLike = (0.0, 0.0, 0.0)
    weight: float = 1.0
    pole: ArrayLike | None = None

    @property
    def values(self) -> Floats:
        """Target positions (F or 1, 3), in metres."""
        return _rows(self.position, 3, "position")


@dataclass(frozen=True, eq=False)
class OrientationTarget:
    """Target orientation of a joint.

    Parameters
    ----------
    joint : index of the joint
    rotation : (4,), or (F, 4) for each frame    unit quaternion, in the world
    weight : weight of the squared angle, at `ANGLE_LENGTH_M` metres per radian
    """

    joint: int
    rotation: ArrayLike
    weight: float = 1.0

    @property
    def values(self) -> Floats:
        """Target rotations (F or 1, 4), quaternions of unit length."""
        return np.asarray(quaternions.normalise(_rows(self.rotation, 4, "rotation")), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LookAtTarget:
    """Point that an axis of a joint, such as the gaze, should be directed at.

    Parameters
    ----------
    joint : index of the joint
    point : (3,), or (F, 3) for each frame    metres, world
    axis : (3,) direction in the joint's frame that should point at the target
    offset : (3,) metres in the joint's frame, from the joint to the eye
    weight : weight of the squared angle, at `ANGLE_LENGTH_M` metres per radian
    """

    joint: int
    point: ArrayLike
    axis: ArrayLike
    offset: ArrayLike = (0.0, 0.0, 0.0)
    weight: float = 1.0

    @property
    def values(self) -> Floats:
        """Target positions (F or 1, 3), in metres."""
        return _rows(self.point, 3, "point")


Target = PositionTarget | OrientationTarget | LookAtTarget


@dataclass(frozen=True, eq=False)
class JointLimit:
    """Limits of a joint's rotation from a reference rotation: first a twist about an axis, then a swing of this axis.

    Parameters
    ----------
    axis, side : (3,) perpendicular unit vectors in the joint's frame: the axis of the twist, and the first axis of the
        swing; the second axis of the swing is axis × side
    twist_rad : least and greatest twist angle
    swing_rad : half axes, about `side` and about axis × side, of the ellipse that contains the swing's rotation vector
    reference : (4,) local rotation from which twist and swing are measured
    """

    axis: ArrayLike
    side: ArrayLike
    twist_rad: tuple[float, float]
    swing_rad: tuple[float, float]
    reference: ArrayLike = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        low, high = self.twist_rad
        if not -math.pi <= low <= high <= math.pi:
            raise EditError(
                f"the twist limits must be increasing and from -π to π, not {low:g} and {high:g}", where="twist_rad"
            )
        if not all(0.0 <= half <= math.pi for half in self.swing_rad):
            raise EditError(f"each swing limit must be from 0 to π, not {self.swing_rad}", where="swing_rad")
        axis, side = _vector(self.axis, "axis"), _vector(self.side, "side")
        if not np.allclose((axis @ axis, side @ side, axis @ side), (1.0, 1.0, 0.0), atol=1e-6):
            raise EditError(
                "the vectors `axis` and `side` must have length 1 and be perpendicular to each other", where="axis"
            )

    @classmethod
    def hinge(
        cls, axes: JointAxes, least_rad: float, greatest_rad: float, reference: ArrayLike = (1.0, 0.0, 0.0, 0.0)
    ) -> JointLimit:
        """Make the limit of a joint that turns only about its swing axis, as knees and elbows do.

        Parameters
        ----------
        axes : JointAxes    axes of the joint
        least_rad, greatest_rad : float    bounds of the angle
        reference : (4,)    local rotation at angle 0

        Returns
        -------
        JointLimit    the limit
        """
        return cls(axes.swing, axes.twist, (least_rad, greatest_rad), (0.0, 0.0), reference)

    @classmethod
    def cone(
        cls,
        axes: JointAxes,
        swing_rad: float | tuple[float, float],
        twist_rad: tuple[float, float] = (-math.pi, math.pi),
        reference: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> JointLimit:
        """Make the limit of a joint whose bone stays within a cone, round or elliptical, as shoulders and hips do.

        Parameters
        ----------
        axes : JointAxes    axes of the joint
        swing_rad : float or (float, float)    half angle of a round cone, or both half angles of an elliptical cone
            (`JointLimit.swing_rad`)
        twist_rad : (float, float)    bounds of the twist about the bone; by default, the twist is free
        reference : (4,)    local rotation in the middle of the cone

        Returns
        -------
        JointLimit    the limit
        """
        halves = swing_rad if isinstance(swing_rad, tuple) else (swing_rad, swing_rad)
        return cls(axes.twist, axes.swing, twist_rad, halves, reference)

    @property
    def row(self) -> Floats:
        """Limit as the row (14,) that the kernels read."""
        reference = quaternions.normalise(_rows(self.reference, 4, "reference")[0])
        return np.concatenate(
            (reference, _vector(self.axis, ""), _vector(self.side, ""), self.twist_rad, self.swing_rad)
        )


@dataclass(frozen=True)
class SolverOptions:
    """Tolerances, iteration limit and regularisation of the solvers.

    Parameters
    ----------
    tolerance_m, tolerance_rad : largest error at which a target counts as reached
    most_iterations : maximum number of sweeps (cyclic coordinate descent) or steps (least squares)
    regularisation_m : error, in metres, that costs as much as turning a joint by one radian, or shifting the root by
        one metre (least squares only)
    """

    tolerance_m: float = 1e-4
    tolerance_rad: float = 1e-3
    most_iterations: int = 100
    regularisation_m: float = 1e-3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise EditError(
                    f"the value must be a finite number of at least 0, not {value}", code="option-invalid", where=name
                )


@dataclass(frozen=True, eq=False)
class Freedom:
    """Joints that a solver may turn, with their limits and stiffness.

    Parameters
    ----------
    joints : indices of the joints that may turn; None for all joints between the root and a target
    root_moves : whether the root may be shifted (least squares only)
    limits : limits by joint index; a joint outside its limits is first brought within the limits
    stiffness : stiffness by joint index, from 0 (turns freely, the default) to below 1
    """

    joints: tuple[int, ...] | None = None
    root_moves: bool = False
    limits: dict[int, JointLimit] = field(default_factory=dict)
    stiffness: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for joint, stiffness in self.stiffness.items():
            if not 0.0 <= stiffness < 1.0:
                raise EditError(
                    f"stiffness must be at least 0 and below 1, not {stiffness}", where=f"stiffness of joint {joint}"
                )


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Order in time of the frames of a solver, which lets joints move smoothly from frame to frame.

    Parameters
    ----------
    frames : (F,) int    numbers of the frames, increasing; successive numbers are neighbours
    reach : float    number of frames over which a flip of a limb is spread
    """

    frames: Ints
    reach: float

    @property
    def runs(self) -> tuple[tuple[int, int], ...]:
        """Ranges [start, stop) of indices into `frames` whose frame numbers are consecutive."""
        borders = [0, *(np.flatnonzero(np.diff(self.frames) != 1) + 1).tolist(), len(self.frames)]
        return tuple(pairwise(borders))


def chain_of(skeleton: Skeleton, effector: int, top: int) -> tuple[int, ...]:
    """List the joints from one joint up to another joint above it.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    effector, top : int    indices of the lower and the upper joint

    Returns
    -------
    tuple of int    indices from `effector` to `top`, both included

    Raises
    ------
    EditError    if `top` is not above `effector`
    """
    path = skeleton.path_to_root(effector)
    if top not in path:
        names = skeleton.joint_names
        raise EditError(
            f"the joint {names[top]} is not an ancestor of the target's joint {names[effector]}; choose an ancestor of "
            "this joint as top",
            code="chain-invalid",
            where=names[top],
        )
    return path[: path.index(top) + 1]


def _rows(values: ArrayLike, size: int, where: str) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[-1] != size or not array.size:
        raise EditError(f"the shape must be ({size},) or (frames, {size}), not {array.shape}", where=where)
    if not np.isfinite(array).all():
        raise EditError("all numbers must be finite", where=where)
    return np.atleast_2d(array)


def _vector(values: ArrayLike, where: str) -> Floats:
    rows = _rows(values, 3, where)
    if rows.shape != (1, 3):
        raise EditError(f"the shape must be (3,), not {np.shape(values)}", where=where)
    vector: Floats = rows[0]
    return vector
