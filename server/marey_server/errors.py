"""Errors that the server sends as answers, grouped by HTTP status. The docstring of a class is its default `title`.

Raise them anywhere; the handlers turn them into problem documents. `code` is stable and documented.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from marey_schemas.problems import FieldError


class ApiProblem(Exception):
    """The request could not be carried out.

    If `detail` names something that the request does not name, such as the path of another item, `unnamed` is the text
    for callers who may change the project but not read it. These callers get this text in place of `detail`, also in
    `errors`, and no `context`. If only `context` names such things, `unnamed` is True.
    """

    status: ClassVar[int] = 500
    code: ClassVar[str] = "internal"

    def __init__(
        self,
        detail: str,
        *,
        code: str | None = None,
        errors: Sequence[FieldError] = (),
        context: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
        unnamed: str | Literal[True] | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.error_code = code or type(self).code
        self.errors = tuple(errors)
        self.context = dict(context or {})
        self.headers = dict(headers or {})
        self.unnamed = detail if unnamed is True else unnamed

    @property
    def title(self) -> str:
        """The first line of the class docstring."""
        return (type(self).__doc__ or "").strip().splitlines()[0]


def forget_origin(error: BaseException) -> None:
    """Remove the traceback and the causes from an error that is sent to the client and never logged.

    If a function stores an error in a future, the stack frame of the function refers to the error. The traceback of the
    error also refers to the frame. Such reference cycles would keep the whole body of a refused request in memory until
    the next garbage collection, which stops all threads.
    """
    if isinstance(error, ApiProblem):
        error.__traceback__ = error.__context__ = error.__cause__ = None


# 400


class BadRequestProblem(ApiProblem):
    """The request is malformed."""

    status = 400
    code = "bad-request"


# 401, 403, 404: who may know what


class UnauthenticatedProblem(ApiProblem):
    """A valid credential is needed."""

    status = 401
    code = "unauthenticated"


class ForbiddenProblem(ApiProblem):
    """You may not perform this operation."""

    status = 403
    code = "forbidden"


class NotFoundProblem(ApiProblem):
    """There is nothing here that you may see."""

    status = 404
    code = "not-found"


# 405 to 415: how the request is made


class MethodNotAllowedProblem(ApiProblem):
    """The resource does not support this method."""

    status = 405
    code = "method-not-allowed"


class NotAcceptableProblem(ApiProblem):
    """The header Accept allows none of the media types of this resource."""

    status = 406
    code = "not-acceptable"


class UnsupportedMediaTypeProblem(ApiProblem):
    """The media type or the encoding of the body is not supported."""

    status = 415
    code = "unsupported-media-type"


class TooLargeProblem(ApiProblem):
    """The request is larger than the limit."""

    status = 413
    code = "too-large"


class RangeNotSatisfiableProblem(ApiProblem):
    """The range lies outside the resource."""

    status = 416
    code = "range-not-satisfiable"


# 409, 412, 428: the state of things


class ConflictProblem(ApiProblem):
    """The state of the resource does not allow this."""

    status = 409
    code = "conflict"


class LeaseLostProblem(ConflictProblem):
    """The attempt no longer holds the job, or the author of the job may not run it any more; stop working on it."""

    code = "lease-lost"
    attempt_to_end: tuple[str, int] | None = None
    """Id of the job, and fence of an attempt that still holds it but must end, because the author lost access."""


class QuotaExceededProblem(ConflictProblem):
    """The request would exceed a quota of the user or of the project; nothing was changed."""

    code = "quota-exceeded"


class GoneProblem(ApiProblem):
    """The requested resource existed, but was deleted."""

    status = 410
    code = "gone"


AUTHOR_LOST = "author-lost-access"
"""Reason why an attempt must stop, and code of its job's failure, if the job's author may not run jobs any more."""


class PreconditionFailedProblem(ApiProblem):
    """The resource has changed since you read it."""

    status = 412
    code = "precondition-failed"


class PreconditionRequiredProblem(ApiProblem):
    """Send the header If-Match with the ETag of the state that you want to change."""

    status = 428
    code = "precondition-required"


# 422, 429, 499


class InvalidProblem(ApiProblem):
    """The request is well formed but not valid."""

    status = 422
    code = "invalid"


class TooManyRequestsProblem(ApiProblem):
    """Too many requests; wait and try again."""

    status = 429
    code = "too-many-requests"


class ClientGoneProblem(ApiProblem):
    """The client closed the connection before the request was answered."""

    status = 499
    code = "client-gone"


# 5xx: ours


class DamagedProblem(ApiProblem):
    """Stored data are missing or damaged; the administrator of the server can check them with `marey db fsck`."""

    status = 500
    code = "dataset-damaged"


class UnavailableProblem(ApiProblem):
    """The server cannot answer just now; try again."""

    status = 503
    code = "unavailable"


class StoppingProblem(UnavailableProblem):
    """The server is stopping and accepts no more work."""

    code = "draining"

    def __init__(self) -> None:
        super().__init__(
            "The server is stopping and accepts no more work; try again in a few seconds.",
            headers={"Retry-After": "5"},
        )


class StorageFullProblem(ApiProblem):
    """The server has no space left to store this."""

    status = 507
    code = "storage-full"
