"""Everything that can be wrong with motion data, in one tree.

Each error has a stable `code` (a slug that clients may switch on) and says `where` in the input it was found.
"""

from __future__ import annotations

from typing import ClassVar


class MotionError(ValueError):
    """The motion data cannot be used as asked.

    Parameters
    ----------
    message : what is wrong and what to do about it, for a person
    code : stable slug; each class has its own default
    where : the place in the input (joint, field, frame), or None when it concerns the whole
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
    """The skeleton is not a valid joint hierarchy."""

    default_code = "skeleton-invalid"


class UnknownJoint(SkeletonError):
    """The skeleton has no joint of this name."""

    default_code = "unknown-joint"


class ClipError(MotionError):
    """The clip's arrays do not describe a motion of its skeleton."""

    default_code = "clip-invalid"


class RotationError(MotionError):
    """The numbers do not describe rotations."""

    default_code = "rotation-invalid"


class MappingError(MotionError):
    """The skeleton's joints could not be given the standard names that the operation needs."""

    default_code = "mapping-invalid"


class AnnotationError(MotionError):
    """The segments or keyframes do not fit the clip or each other."""

    default_code = "annotation-invalid"


class EditError(MotionError):
    """The command cannot be applied to this motion."""

    default_code = "edit-invalid"


class ModelError(MotionError):
    """No model can be made of these examples, or the numbers describe none."""

    default_code = "model-invalid"


# Files


class FormatError(MotionError):
    """The file is not what its format says it should be.

    Parameters
    ----------
    file : name of the file as the user knows it
    line : 1-based line number, for text formats
    joint : name of the joint that was being read
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
    """No reader recognises the file."""

    default_code = "format-unknown"


class AmbiguousUnits(FormatError):
    """The file does not say its unit of length and its sizes fit more than one."""

    default_code = "units-ambiguous"


class FormatLimit(FormatError):
    """The file asks for more joints, frames or bytes than a reader accepts."""

    default_code = "format-limit"
