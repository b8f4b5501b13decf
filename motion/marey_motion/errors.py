"""Errors in motion data, all derived from `MotionError`.

Each error has a stable `code`, a slug by which clients can distinguish errors. It may also have `where`, the place of
the error in the input.
"""

from __future__ import annotations

from typing import ClassVar


class MotionError(ValueError):
    """The motion data cannot be used for the requested operation.

    Parameters
    ----------
    message : str    the problem and its remedy, for a person
    code : str, optional    stable slug; each class has its own default
    where : str, optional    place in the input (joint, field, frame); None when the error concerns the whole input

    Examples
    --------
    >>> from marey_motion import MotionError, generate_gait
    >>> try:
    ...     generate_gait(1.2, 0.0, duration_s=-1.0)
    ... except MotionError as error:
    ...     print(error.where)
    duration_s
    """

    default_code: ClassVar[str] = "motion-invalid"

    def __init__(self, message: str, *, code: str | None = None, where: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or self.default_code
        self.where = where

    def __str__(self) -> str:
        return f"{self.where}: {self.message}" if self.where else self.message

    def __reduce__(self) -> tuple[object, ...]:
        # The constructor has keyword-only parameters, which plain exception pickling would drop between processes.
        return _restore, (type(self), self.message, dict(vars(self)))


def _restore(error_type: type[MotionError], message: str, state: dict[str, object]) -> MotionError:
    error = error_type.__new__(error_type, message)
    ValueError.__init__(error, message)
    vars(error).update(state)
    return error


# The core types


class SkeletonError(MotionError):
    """The skeleton is not a valid joint hierarchy.

    Examples
    --------
    >>> from marey_motion import SkeletonError, studio_skeleton
    >>> try:
    ...     studio_skeleton(stature_m=0.0)
    ... except SkeletonError as error:
    ...     print(error.code)
    skeleton-invalid
    """

    default_code = "skeleton-invalid"


class UnknownJoint(SkeletonError):
    """The skeleton has no joint of this name.

    Examples
    --------
    >>> from marey_motion import UnknownJoint, studio_skeleton
    >>> try:
    ...     studio_skeleton().index_of("LeftKnee")
    ... except UnknownJoint as error:
    ...     print(error)
    LeftKnee: no joint is called 'LeftKnee'; did you mean LeftLeg or LeftToeBase or LeftHand?
    """

    default_code = "unknown-joint"


class ClipError(MotionError):
    """The clip's arrays do not describe a motion of its skeleton.

    Examples
    --------
    >>> from marey_motion import ClipError, generate_gait
    >>> try:
    ...     generate_gait(1.2, 0.0, 2.0).sliced(5, 5)
    ... except ClipError as error:
    ...     print(error)
    slice: the range of frames 5:5 must lie within 0:120, and its start must be before its stop
    """

    default_code = "clip-invalid"


class RotationError(MotionError):
    """The numbers do not describe rotations.

    Examples
    --------
    >>> from marey_motion import RotationError, quaternions
    >>> try:
    ...     quaternions.normalise([0.0, 0.0, 0.0, 0.0])
    ... except RotationError as error:
    ...     print(error)
    a quaternion of length zero has no direction
    """

    default_code = "rotation-invalid"


class MappingError(MotionError):
    """The joint mapping, or the axes of the mapped joints, cannot be used for the requested operation.

    Examples
    --------
    >>> from marey_motion import MappingError, map_joints, studio_skeleton
    >>> skeleton = studio_skeleton()
    >>> try:
    ...     map_joints(skeleton).indices(skeleton, ["left_wing"])
    ... except MappingError as error:
    ...     print(error)
    left_wing: the joint mapping contains no joint for left_wing; add the missing joints to the mapping
    """

    default_code = "mapping-invalid"


class AnnotationError(MotionError):
    """The segments or keyframes do not fit the clip or each other."""

    default_code = "annotation-invalid"


class EditError(MotionError):
    """The editing command cannot be applied to this motion."""

    default_code = "edit-invalid"


class ModelError(MotionError):
    """No model can be trained on the given examples, or the numbers of a stored model are not valid."""

    default_code = "model-invalid"


# Files


class FormatError(MotionError):
    """The file does not follow its format.

    Parameters
    ----------
    message : str    the problem and its remedy, for a person
    code : str, optional    stable slug; each class has its own default
    file : str, optional    name of the file as the user knows it
    line : int, optional    1-based line number, for text formats
    joint : str, optional    name of the joint that was being read

    Examples
    --------
    >>> from marey_motion import FormatError, read_motion
    >>> try:
    ...     read_motion(b"HIERARCHY", "walk.bvh")
    ... except FormatError as error:
    ...     print(error.code, error.file)
    file-truncated walk.bvh
    """

    default_code = "format-invalid"

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        file: str | None = None,
        line: int | None = None,
        joint: str | None = None,
    ) -> None:
        place = ":".join(str(part) for part in (file, line) if part is not None)
        spot = ", ".join(part for part in (place, f"joint {joint}" if joint is not None else "") if part)
        super().__init__(message, code=code, where=spot or None)
        self.file = file
        self.line = line
        self.joint = joint


class UnknownFormat(FormatError):
    """The file has a format that no reader recognises.

    Examples
    --------
    >>> from marey_motion import UnknownFormat, read_motion
    >>> try:
    ...     read_motion(b"hello", "hello.txt")
    ... except UnknownFormat as error:
    ...     print(error.code)
    format-unknown
    """

    default_code = "format-unknown"


class AmbiguousUnits(FormatError):
    """The unit of length or the upward axis is not known: neither the file nor the body in it determines it.

    Examples
    --------
    >>> from marey_motion import AmbiguousUnits, ImportOptions, generate_gait, read_motion, write_motion
    >>> data = write_motion(generate_gait(1.2, 0.0, 2.0), "bvh", unit=0.00137)
    >>> try:
    ...     read_motion(data, "walk.bvh")
    ... except AmbiguousUnits as error:
    ...     print(error.code)
    units-ambiguous
    >>> read_motion(data, "walk.bvh", options=ImportOptions(unit_scale_m=0.00137)).source.unit_scale_m
    0.00137
    """

    default_code = "units-ambiguous"


class ContradictedOption(FormatError):
    """The motion in the file contradicts the unit, the upward axis or the frame rate that the caller gave.

    Examples
    --------
    >>> from marey_motion import ContradictedOption, ImportOptions, generate_gait, read_motion, write_motion
    >>> data = write_motion(generate_gait(1.2, 0.0, 2.0), "bvh", unit="cm")
    >>> try:
    ...     read_motion(data, "walk.bvh", options=ImportOptions(unit="m"))
    ... except ContradictedOption as error:
    ...     print(error.code)
    option-contradicted
    >>> read_motion(data, "walk.bvh", options=ImportOptions(unit="m", trust_options=True)).source.unit_scale_m
    1.0
    """

    default_code = "option-contradicted"


class FormatLimit(FormatError):
    r"""The file has more joints, frames or bytes than a reader accepts.

    Examples
    --------
    >>> from marey_motion import FormatLimit, read_motion
    >>> joints = "".join(f"JOINT {n}\n{{\nOFFSET 0 1 0\nCHANNELS 0\n" for n in range(20_000))
    >>> try:
    ...     read_motion(f"HIERARCHY\nROOT root\n{{\nOFFSET 0 0 0\nCHANNELS 0\n{joints}".encode(), "deep.bvh")
    ... except FormatLimit as error:
    ...     print(error.code)
    format-limit
    """

    default_code = "format-limit"
