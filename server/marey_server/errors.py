"""Every error the server answers with, grouped by status. Each class docstring is the default `title`.

Raise them anywhere; the handlers turn them into problem documents. `code` is stable and documented.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from marey_schemas.problems import FieldError


class MareyError(Exception):
    """The request could not be carried out."""

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
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.error_code = code or type(self).code
        self.errors = tuple(errors)
        self.context = dict(context or {})
        self.headers = dict(headers or {})

    @property
    def title(self) -> str:
        """The first line of the class docstring."""
        return (type(self).__doc__ or "").strip().splitlines()[0]


# 400


class BadRequest(MareyError):
    """The request is malformed."""

    status = 400
    code = "bad-request"


# 401, 403, 404: who may know what


class Unauthenticated(MareyError):
    """A valid credential is needed."""

    status = 401
    code = "unauthenticated"


class Forbidden(MareyError):
    """You may see this, but not do that."""

    status = 403
    code = "forbidden"


class NotFound(MareyError):
    """There is nothing here that you may see."""

    status = 404
    code = "not-found"


# 405 to 415: how the request is made


class MethodNotAllowed(MareyError):
    """The resource does not know this method."""

    status = 405
    code = "method-not-allowed"


class NotAcceptable(MareyError):
    """No offered media type is accepted."""

    status = 406
    code = "not-acceptable"


class UnsupportedMediaType(MareyError):
    """The body's media type is not understood."""

    status = 415
    code = "unsupported-media-type"


class TooLarge(MareyError):
    """The request is larger than the limit."""

    status = 413
    code = "too-large"


class RangeNotSatisfiable(MareyError):
    """The range lies outside the resource."""

    status = 416
    code = "range-not-satisfiable"


# 409, 412, 428: the state of things


class Conflict(MareyError):
    """The state of the resource does not allow this."""

    status = 409
    code = "conflict"


class LeaseLost(Conflict):
    """The lease is held by somebody else or has ended; stop working on the job."""

    code = "lease-lost"


class PreconditionFailed(MareyError):
    """The resource has changed since you read it."""

    status = 412
    code = "precondition-failed"


class PreconditionRequired(MareyError):
    """Say which state you are changing: send If-Match."""

    status = 428
    code = "precondition-required"


# 422, 429


class Invalid(MareyError):
    """The request is well formed, but what it asks for makes no sense."""

    status = 422
    code = "invalid"


class TooManyRequests(MareyError):
    """Too many requests; wait and try again."""

    status = 429
    code = "too-many-requests"


# 5xx: ours


class Unavailable(MareyError):
    """The server cannot answer just now; try again."""

    status = 503
    code = "unavailable"


class StorageFull(MareyError):
    """There is no room left to store this."""

    status = 507
    code = "storage-full"
