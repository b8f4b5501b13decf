"""The joint hierarchy that clips move: names, parents, offsets and rest pose.

Coordinates are right-handed with Y up, in metres; quaternions are (w, x, y, z).
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from marey_motion.errors import SkeletonError, UnknownJoint
from marey_schemas.documents.clips import UNIT_TOLERANCE

SAME_OFFSET_M = 1e-3
"""Bone offsets of two files may differ by this much, in metres, and still be those of one skeleton."""
SAME_SKELETON_M = 1e-5
"""Bone offsets may change by this much, in metres, due to rounding when a file is written and read again."""

_Vector: TypeAlias = tuple[float, float, float]
_Rotation: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class EndSite:
    """The tip of a chain: a point without a rotation of its own.

    Parameters
    ----------
    joint : int    index of the joint to which it belongs
    offset : (3,) float64    metres, in that joint's frame

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import EndSite
    >>> EndSite(joint=5, offset=np.array([0.0, 0.2, 0.0])).offset
    array([0. , 0.2, 0. ])
    """

    joint: int
    offset: NDArray[np.float64]

    def __post_init__(self) -> None:
        object.__setattr__(self, "offset", _frozen(self.offset, np.float64, (3,), "end site offset"))


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A tree of joints, ordered so that parents come before their children.

    Arrays of the right type are not copied. The arrays of a skeleton are read-only.

    Parameters
    ----------
    joint_names : tuple of str    unique names; joint 0 is the root
    parents : (J,) int32    index of the parent, smaller than the joint's own; -1 for the root
    offsets : (J, 3) float64    metres, in the parent's frame; for the root its rest position
    rest_rotations : (J, 4) float64    unit local rotation (w, x, y, z) at rest, which is replaced by the rotation in a
        clip
    end_sites : tuple of EndSite    tips of chains
    display_names : tuple of str    names as in the source file, where they may repeat; `joint_names` when left out

    Raises
    ------
    SkeletonError    naming the invalid joint and field

    Examples
    --------
    >>> import numpy as np
    >>> from marey_motion import Skeleton
    >>> upright = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    >>> leg = Skeleton(("Hip", "Knee"), [-1, 0], [[0.0, 0.9, 0.0], [0.0, -0.45, 0.0]], upright)
    >>> leg.rest_global_positions[leg.index_of("Knee")]
    array([0.  , 0.45, 0.  ])
    """

    joint_names: tuple[str, ...]
    parents: NDArray[np.int32]
    offsets: NDArray[np.float64]
    rest_rotations: NDArray[np.float64]
    end_sites: tuple[EndSite, ...] = ()
    display_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = _checked_names(self.joint_names)
        count = len(names)
        set_field = object.__setattr__
        set_field(self, "joint_names", names)
        set_field(self, "display_names", tuple(self.display_names) or names)
        set_field(self, "parents", _frozen(self.parents, np.int32, (count,), "parents"))
        set_field(self, "offsets", _frozen(self.offsets, np.float64, (count, 3), "offsets"))
        set_field(self, "rest_rotations", _frozen(self.rest_rotations, np.float64, (count, 4), "rest_rotations"))
        set_field(self, "end_sites", tuple(self.end_sites))
        if len(self.display_names) != count:
            raise SkeletonError(
                f"there are {len(self.display_names)} display names for {count} joints; each joint needs one",
                where="display_names",
            )
        self._check_tree()
        self._check_rest_rotations()

    def _check_tree(self) -> None:
        if self.parents[0] != -1:
            raise SkeletonError("the first joint must be the root, with parent -1", where=self.joint_names[0])
        wrong = np.flatnonzero((self.parents[1:] < 0) | (self.parents[1:] >= np.arange(1, self.joint_count)))
        if wrong.size:
            joint = int(wrong[0]) + 1
            raise SkeletonError(
                f"parent {self.parents[joint]} of joint {joint} must be an earlier joint (0 to {joint - 1})",
                where=self.joint_names[joint],
            )
        for site in self.end_sites:
            if not 0 <= site.joint < self.joint_count:
                raise SkeletonError(
                    f"an end site belongs to joint {site.joint}, but the skeleton has only {self.joint_count} joints",
                    where="end_sites",
                )

    def _check_rest_rotations(self) -> None:
        norms = np.linalg.norm(self.rest_rotations, axis=1)
        wrong = np.flatnonzero(np.abs(norms - 1.0) > UNIT_TOLERANCE)
        if wrong.size:
            joint = int(wrong[0])
            raise SkeletonError(
                f"the rest rotation must be a unit quaternion (w, x, y, z), but has the length {norms[joint]:.6g}",
                where=self.joint_names[joint],
            )

    @property
    def joint_count(self) -> int:
        """Number of joints, end sites not counted."""
        return len(self.joint_names)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """Indices of each joint's children, in order."""
        lists: list[list[int]] = [[] for _ in self.joint_names]
        for joint, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                lists[parent].append(joint)
        return tuple(tuple(one) for one in lists)

    @cached_property
    def _indices(self) -> dict[str, int]:
        return {name: joint for joint, name in enumerate(self.joint_names)}

    def index_of(self, name: str) -> int:
        """Find a joint by name.

        Parameters
        ----------
        name : str    a joint name, not a display name

        Returns
        -------
        int    index into `joint_names`

        Raises
        ------
        UnknownJoint    with the most similar names, if no joint has this name
        """
        joint = self._indices.get(name)
        if joint is None:
            near = difflib.get_close_matches(name, self.joint_names, n=3)
            hint = f"; did you mean {' or '.join(near)}?" if near else f"; the root is {self.joint_names[0]}"
            raise UnknownJoint(f"no joint is called {name!r}{hint}", where=name)
        return joint

    def __contains__(self, name: object) -> bool:
        return name in self._indices

    def path_to_root(self, joint: int) -> tuple[int, ...]:
        """List the joints from one joint up to the root.

        Parameters
        ----------
        joint : int    index of the first joint

        Returns
        -------
        tuple of int    indices from `joint` to the root, both included
        """
        path = [joint]
        while (parent := int(self.parents[path[-1]])) >= 0:
            path.append(parent)
        return tuple(path)

    @cached_property
    def rest_global_rotations(self) -> NDArray[np.float64]:
        """Global rotations (J, 4) of the joints in the rest pose, as (w, x, y, z)."""
        turns: list[_Rotation] = self.rest_rotations.tolist()
        for joint, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                turns[joint] = _product(turns[parent], turns[joint])
        result = np.array(turns)
        result.setflags(write=False)
        return result

    @cached_property
    def rest_global_positions(self) -> NDArray[np.float64]:
        """Global positions (J, 3) of the joints in the rest pose, in metres."""
        points: list[_Vector] = self.offsets.tolist()
        turns: list[_Rotation] = self.rest_global_rotations.tolist()
        for joint, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                x, y, z = _rotated(turns[parent], points[joint])
                px, py, pz = points[parent]
                points[joint] = px + x, py + y, pz + z
        result = np.array(points)
        result.setflags(write=False)
        return result


def same_hierarchy(a: Skeleton, b: Skeleton, *, tolerance_m: float = 0.0) -> bool:
    """Check whether clips of one skeleton are also clips of another.

    Joint names, parents, offsets, rest rotations and end sites must be equal; display names may differ.

    Parameters
    ----------
    a, b : Skeleton    the skeletons
    tolerance_m : float    metres by which each component of the offset of a joint or end site may differ

    Returns
    -------
    bool    True if clips of one are clips of the other

    Examples
    --------
    >>> from marey_motion import same_hierarchy, studio_skeleton
    >>> same_hierarchy(studio_skeleton(1.78), studio_skeleton(1.60))
    False
    """
    if a is b:
        return True
    if a.joint_names != b.joint_names or not np.array_equal(a.parents, b.parents):
        return False
    if [site.joint for site in a.end_sites] != [site.joint for site in b.end_sites]:
        return False
    offsets = [(a.offsets, b.offsets)] + [(s.offset, t.offset) for s, t in zip(a.end_sites, b.end_sites, strict=True)]
    if not all(np.all(np.abs(left - right) <= tolerance_m) for left, right in offsets):
        return False
    aligned = np.abs(np.sum(a.rest_rotations * b.rest_rotations, axis=1))
    return bool(np.all(aligned >= 1.0 - 1e-9))


# Plain numbers: for a few dozen joints, one after the other, they take a tenth of the time of `quaternions`, and the
# same operations in the same order give the same bits.


def _product(a: _Rotation, b: _Rotation) -> _Rotation:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _rotated(q: _Rotation, v: _Vector) -> _Vector:
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + (y * tz - z * ty),
        vy + w * ty + (z * tx - x * tz),
        vz + w * tz + (x * ty - y * tx),
    )


def _checked_names(names: Sequence[str]) -> tuple[str, ...]:
    names = tuple(names)
    if not names:
        raise SkeletonError("a skeleton needs at least one joint", where="joint_names")
    for joint, name in enumerate(names):
        if not isinstance(name, str) or not name:
            raise SkeletonError(f"the name of joint {joint} must be nonempty text, not {name!r}", where="joint_names")
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise SkeletonError(
            f"joint names must be unique, but two joints are called {repeated[0]!r}", where="joint_names"
        )
    return names


def _frozen(values: ArrayLike, dtype: DTypeLike, shape: tuple[int, ...], field: str) -> NDArray[np.generic]:
    """Make a read-only view of `values` as `dtype`; the caller's own array keeps its flags."""
    array = np.asarray(values)
    if array.shape != shape:
        raise SkeletonError(f"the array has the shape {array.shape}, but must have {shape}", where=field)
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise SkeletonError(f"the array must contain numbers, not values of the type {array.dtype}", where=field)
    if not np.all(np.isfinite(array)):
        raise SkeletonError("all numbers must be finite", where=field)
    view: NDArray[np.generic] = np.asarray(array, dtype=dtype).view()
    view.setflags(write=False)
    return view
