"""Takes, which the commands of an edit receive and return: a motion with its skeleton, findings and limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.editing.compute_budget import PER_NUMBER, ComputeBudget
from marey_motion.errors import EditError, MappingError
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import JointMapping, map_joints, symmetric_joints
from marey_motion.skeleton import Skeleton

MOST_NUMBERS = 200_000_000
"""Maximum number of values in the arrays of a motion that a command makes.

The maximum corresponds to 1.6 GB of memory, or to two and a half hours of a motion with 60 joints at 90 Hz.
"""


UNIT_IN_SINGLE = 3e-7
"""Largest deviation from 1 of the squared length of a unit quaternion after rounding to single precision."""


@dataclass(frozen=True, eq=False)
class EditedBody:
    """A skeleton with its standard joints, which are determined when a command first needs them.

    Parameters
    ----------
    skeleton : Skeleton    skeleton of the motion
    find_mapping : callable    returns the standard joints; may raise `MappingError`
    """

    skeleton: Skeleton
    find_mapping: Callable[[Skeleton], JointMapping] = map_joints

    @cached_property
    def mapping(self) -> JointMapping:
        """Joint name by standard name."""
        return self.find_mapping(self.skeleton)

    @cached_property
    def partners(self) -> NDArray[np.int32]:
        """Index (J,) of each joint's partner on the other side of the body; central joints are their own partners."""
        return symmetric_joints(self.skeleton, self.mapping)

    @cached_property
    def pelvis(self) -> int:
        """Index of the joint that represents the body's position: the pelvis, or the root if no pelvis is known."""
        return self.skeleton.index_of(self.mapping.joints.get("pelvis", self.skeleton.joint_names[0]))

    @cached_property
    def carrier(self) -> int:
        """Index of the joint that carries the body (`MatchingBody.carrier`); the root if `matching` raises an error."""
        try:
            return self.matching.carrier
        except MappingError:
            return 0

    @cached_property
    def matching(self) -> MatchingBody:
        """Joints of hips, shoulders, feet and toes. Raises a `MappingError` that names the missing standard joints."""
        return MatchingBody.from_mapping(self.skeleton, self.mapping)


@dataclass(frozen=True)
class EditFinding:
    """Values that a command reports, such as the height of the ground or the remaining errors of constraints.

    Parameters
    ----------
    command : str    name of the command
    values : mapping    plain tree of text and numbers
    """

    command: str
    values: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Take:
    """Motion between two commands of an edit, in double precision.

    Parameters
    ----------
    motion : the frames
    frame_rate_hz : frames per second
    body : the skeleton and its standard joints
    sources : other clips, by the names that commands use
    findings : values that the commands reported so far
    pieces : for each split that was applied, the number of the piece that contains this motion, counted from 1
    most_numbers : largest number of values that the motion may have
    budget : remaining work of the whole edit
    """

    motion: Motion
    frame_rate_hz: float
    body: EditedBody
    sources: Mapping[str, Clip] = field(default_factory=lambda: MappingProxyType({}))
    findings: tuple[EditFinding, ...] = ()
    pieces: tuple[int, ...] = ()
    most_numbers: int = MOST_NUMBERS
    budget: ComputeBudget = field(default_factory=ComputeBudget)

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton of the body."""
        return self.body.skeleton

    @property
    def frame_count(self) -> int:
        """Number of frames of the motion."""
        return self.motion.frame_count

    @property
    def size(self) -> int:
        """Number of values in the motion's arrays."""
        motion = self.motion
        return int(motion.root_translations.size + motion.rotations.size + motion.translations.size)

    def with_motion(self, motion: Motion) -> Take:
        """Replace the motion with another one of the same body and frame rate.

        Parameters
        ----------
        motion : Motion    the new motion

        Returns
        -------
        Take    the take with the new motion
        """
        return replace(self, motion=motion)

    def with_finding(self, finding: EditFinding) -> Take:
        """Add a finding, such as the height of the ground.

        Parameters
        ----------
        finding : EditFinding    the finding

        Returns
        -------
        Take    the take with one more finding
        """
        return replace(self, findings=(*self.findings, finding))

    def with_warning(self, command: str, warning: str) -> Take:
        """Add a finding that warns of a parameter that does not fit the motion.

        Parameters
        ----------
        command : str    name of the command
        warning : str    what does not fit, as a sentence without a full stop

        Returns
        -------
        Take    the take with one more finding
        """
        return self.with_finding(EditFinding(command, {"warning": warning}))

    def source(self, name: str) -> Clip:
        """Look up another clip, by the name that a command uses.

        Parameters
        ----------
        name : str    the name

        Returns
        -------
        Clip    the clip

        Raises
        ------
        EditError    if there is no such clip
        """
        if name not in self.sources:
            known = ", ".join(sorted(self.sources)) or "none"
            raise EditError(
                f"no source clip is called {name!r}; the source clips are: {known}",
                code="source-missing",
                where="source",
            )
        return self.sources[name]

    def frames(self, bounds: tuple[int, int | None] | None) -> tuple[int, int]:
        """Resolve a half-open range of frames.

        Parameters
        ----------
        bounds : (int, int or None) or None    start and stop; a stop of None is the end of the motion, and bounds of
            None are all frames

        Returns
        -------
        (int, int)    start and stop

        Raises
        ------
        EditError    if the take has no such frames
        """
        start, stop = bounds or (0, None)
        stop = self.frame_count if stop is None else stop
        if not 0 <= start < stop <= self.frame_count:
            raise EditError(
                f"the range {start}:{stop} must be within the clip's frames 0:{self.frame_count}, with its start "
                "before its stop",
                code="frames-missing",
            )
        return start, stop

    def joint(self, name: str) -> int:
        """Find a joint by name.

        Parameters
        ----------
        name : str    name of the joint

        Returns
        -------
        int    index of the joint

        Raises
        ------
        UnknownJoint    if there is no such joint; the error suggests similar names
        """
        return self.skeleton.index_of(name)

    def count_frames(self, seconds: float) -> int:
        """Convert a time to the nearest number of frames.

        Parameters
        ----------
        seconds : float    seconds

        Returns
        -------
        int    frames
        """
        return round(seconds * self.frame_rate_hz)

    def require_room(self, frames: int) -> None:
        """Check that a motion with a given number of frames is not too large, and subtract its work from the budget.

        Parameters
        ----------
        frames : int    number of frames

        Raises
        ------
        EditError    if the motion would have more values than `most_numbers`, or its work exceeds the budget
        """
        width = 3 + 4 * self.skeleton.joint_count + 3 * len(self.motion.translated_joints)
        most = self.most_numbers // width
        if frames > most:
            raise EditError(
                f"the edited clip would have {frames:,} frames; with this skeleton a clip may have at most {most:,}; "
                "choose a shorter clip or a lower frame rate",
                code="edit-too-large",
            )
        self.budget.spend(PER_NUMBER * width * frames)


def motion_of(clip: Clip) -> Motion:
    """Convert a clip to double precision, with unit quaternions whose signs are continuous in time.

    If the quaternions of the clip already have unit length, within single precision, and continuous signs, frames that
    no command changes are bit-identical after converting back.

    Parameters
    ----------
    clip : Clip    F frames

    Returns
    -------
    Motion    F frames
    """
    nothing = np.zeros((clip.frame_count, 0, 3))
    return with_unit_rotations(
        Motion(
            clip.root_translations.astype(np.float64),
            clip.rotations.astype(np.float64),
            nothing if clip.translations is None else clip.translations.astype(np.float64),
            clip.translated_joints,
        )
    )


def with_unit_rotations(motion: Motion) -> Motion:
    """Normalise rotations to unit length, and choose the signs of quaternions so that they are continuous in time.

    Rotations whose length is 1 within single precision are not normalised.

    Parameters
    ----------
    motion : Motion    F frames

    Returns
    -------
    Motion    F frames

    Raises
    ------
    EditError    if a rotation is not finite
    """
    rotations = motion.rotations
    squares = np.einsum("fjc,fjc->fj", rotations, rotations)
    require_finite(squares)
    off = np.abs(squares - 1.0) > UNIT_IN_SINGLE
    turned_over = np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]) < 0.0
    if not (off.any() or turned_over.any()):
        return motion
    rotations = rotations.copy()
    rotations[off] /= np.sqrt(squares[off])[:, None]
    rotations[1:][np.cumsum(turned_over, axis=0) % 2 == 1] *= -1.0
    return motion._replace(rotations=rotations)


def require_finite(numbers: Floats) -> None:
    """Check that all numbers are finite.

    Parameters
    ----------
    numbers : (F, ...) float64    numbers of each frame

    Raises
    ------
    EditError    if a number is not finite; the error names the first such frame
    """
    if not np.isfinite(numbers).all():
        frame = int(np.argmin(np.isfinite(numbers.reshape(len(numbers), -1)).all(axis=1)))
        raise EditError(
            f"frame {frame} of the edited motion contains a number that is not finite (infinite or NaN)",
            code="edit-not-finite",
        )
