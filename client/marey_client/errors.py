"""Errors of the SDK. `RequestFailed` and its subclasses are reported by the server; the others arise in the client."""

from __future__ import annotations

from typing import Any, ClassVar

from marey_schemas.problems import FieldError, Problem


class MareyError(Exception):
    """Base class of all errors of Marey's client; the texts of the errors are written for people."""


class BadArgument(MareyError, ValueError):
    """An argument of a function of the SDK is not valid; the text names the argument."""


# Nobody answered, or somebody else did


class Unreachable(MareyError):
    """The server cannot be reached, or the connection was lost before it answered."""


class ConnectionClosed(MareyError):
    """The client was closed before a call ended, or before the call began."""

    def __init__(self) -> None:
        super().__init__("the client is closed; keep it open until all calls have ended")


class UnexpectedAnswer(MareyError):
    """An answer of the server is not valid, or lacks requested data; the text gives the reason."""


# What happened on this machine


class NoCredential(MareyError):
    """No token was given and none is stored for this server."""


class BadCredentialFile(MareyError):
    """A token file contains no token, or other users may read it."""


class BadToken(MareyError):
    """A given token does not have the form of a token."""


class BadAddress(MareyError):
    """The address of a server is not valid."""


class DigestMismatch(MareyError):
    """The received bytes do not have the requested digest."""


class BlobTooLarge(MareyError):
    """A blob is larger than the caller allows; it was not downloaded."""

    def __init__(self, digest: str, size_bytes: int, most_bytes: int) -> None:
        super().__init__(f"the file {digest} has {size_bytes} bytes, but at most {most_bytes} are allowed here")
        self.digest = digest
        self.size_bytes = size_bytes


class ArchiveInUse(MareyError):
    """Another process is writing the archive."""


class EarlierVersionsMissing(MareyError):
    """The archive builds on a version that the dataset does not have."""


class DifferencesRefused(MareyError):
    """A server refused revisions whose arrays were sent as differences; the server may accept whole arrays."""


class LargeCommit(MareyError):
    """A commit changes more entries than a server accepts in a commit from an archive or another server."""


class NothingToArchive(MareyError):
    """An archive would contain no commit, because all of its commits are to be left out."""


class CannotExport(MareyError):
    """The version of a dataset, or a clip in it, cannot be exported in the chosen layout."""


class NotReplaced(MareyError):
    """The file to write exists and is not an archive, so that it is not replaced."""


class FolderNotEmpty(MareyError):
    """The folder to write exists and is not empty, or is a file."""


class BadSidecar(MareyError):
    """The file `marey.json` in a folder is not the sidecar of an export, or is damaged."""


class MissingPackage(MareyError):
    """A Python package that only some functions need is not installed."""


class CannotBisect(MareyError):
    """A search for the first bad version between two versions is not possible; the text gives the reason."""


class NotComparable(MareyError):
    """Two results cannot be compared, because their numbers mean different things; the text says what to do."""


class FileChanged(MareyError):
    """A file changed while it was being sent."""


class NothingToUpload(MareyError):
    """The given places do not exist, or contain no motion files that can be imported."""


class BadFileName(MareyError):
    """A file has a name that a request cannot contain."""


class SameName(MareyError):
    """Two files of one import would get the same name on the server."""


class NoSuchPath(MareyError, KeyError):
    """No item or folder of a project has the given path; the text names the nearest one."""

    __str__ = Exception.__str__  # a KeyError would show the text in quotation marks


class NoSuchJoint(MareyError):
    """A motion has no joint with the given name; the text names the nearest one."""


class NoAnnotations(MareyError):
    """None of the given clips has an annotation in the requested layer."""


# How jobs end


class JobUnsuccessful(MareyError):
    """An awaited job failed or was cancelled; `job` contains its final state."""

    def __init__(self, message: str, job: Any) -> None:
        super().__init__(message)
        self.job = job

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (*self.args, self.job)


class WaitedTooLong(MareyError):
    """A job did not end within the time to wait; it continues on the server."""


# The server's problem documents, by status


class RequestFailed(MareyError):
    """The server answered a request with an error; subclasses distinguish the errors."""

    status: ClassVar[int] = 0

    def __init__(
        self, problem: Problem, *, retry_after_s: float | None = None, anonymous: bool = False, server: str = ""
    ) -> None:
        super().__init__(problem.detail)
        self.problem = problem
        self.retry_after_s = retry_after_s
        self.anonymous = anonymous
        self.server = server

    def __str__(self) -> str:
        if len(self.errors) == 1 and self.errors[0].detail == self.detail:
            return ": ".join(text for text in (self.errors[0].pointer, self.detail) if text)
        whole = self.detail
        for text in (f"{field.pointer}: {field.detail}" for field in self.errors):
            if text not in self.detail:
                whole += f" {text}" if whole.endswith(".") else f"; {text}"
        return whole

    def __reduce__(self) -> tuple[Any, ...]:
        # The other members come back as the instance's dictionary; so do notes.
        return type(self), (self.problem,), self.__dict__

    @property
    def code(self) -> str:
        """The short name of the error, such as `name-taken`, for programs."""
        return self.problem.code

    @property
    def detail(self) -> str:
        """The explanation of the error, for people."""
        return self.problem.detail

    @property
    def request_id(self) -> str:
        """The id of the request, to quote when asking for help."""
        return self.problem.instance

    @property
    def errors(self) -> tuple[FieldError, ...]:
        """The invalid fields of the request, one entry for each."""
        return self.problem.errors

    @property
    def context(self) -> dict[str, Any]:
        """Details of the error by name, such as the current revision."""
        return self.problem.context


class BadRequest(RequestFailed):
    """The request is malformed, for example a query parameter."""

    status = 400


class Unauthenticated(RequestFailed):
    """The request needs a valid token: it had none, or its token is unknown, revoked or expired."""

    status = 401


class Forbidden(RequestFailed):
    """The token allows reading the resource, but not the requested change."""

    status = 403


class NotFound(RequestFailed):
    """The resource does not exist, or the token does not allow reading it."""

    status = 404


class Conflict(RequestFailed):
    """The present state of the resource does not allow the request."""

    status = 409


class LeaseLost(Conflict):
    """The lease of the job has ended, or another worker has it now; stop working on the job."""


class PreconditionFailed(RequestFailed):
    """The resource has changed since it was read; read it again, and repeat the change."""

    status = 412


class TooLarge(RequestFailed):
    """The request is larger than the server accepts."""

    status = 413


class Invalid(RequestFailed):
    """The request is well formed but not valid; `errors` names the invalid fields."""

    status = 422


class TooManyRequests(RequestFailed):
    """The client sends too many requests; the server asks it to wait."""

    status = 429


class ServerFailed(RequestFailed):
    """The server failed; the request id helps to find out why."""

    status = 500


class Unavailable(ServerFailed):
    """The server cannot answer at the moment."""

    status = 503


class StorageFull(ServerFailed):
    """The server has no storage space left."""

    status = 507


_BY_STATUS: dict[int, type[RequestFailed]] = {
    error.status: error
    for error in (
        BadRequest,
        Unauthenticated,
        Forbidden,
        NotFound,
        Conflict,
        PreconditionFailed,
        TooLarge,
        Invalid,
        TooManyRequests,
        ServerFailed,
        Unavailable,
        StorageFull,
    )
}
_BY_CODE: dict[str, type[RequestFailed]] = {"lease-lost": LeaseLost}


def error_of(
    problem: Problem, *, retry_after_s: float | None = None, anonymous: bool = False, server: str = ""
) -> RequestFailed:
    """Return the exception for a problem document; its class is found by code, then by status.

    `anonymous` states whether the request had no token, and `server` is the address of the server.
    """
    known = _BY_CODE.get(problem.code) or _BY_STATUS.get(problem.status)
    kind = known or (ServerFailed if problem.status >= 500 else RequestFailed)
    return kind(problem, retry_after_s=retry_after_s, anonymous=anonymous, server=server)
