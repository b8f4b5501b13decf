"""Declarations of handler methods by the decorators `@reads` and `@writes`.

The decorators attach an `Operation` to a method. The checks before the method runs, the OpenAPI document, the
documentation page and the access test are all derived from this `Operation`.
"""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from enum import StrEnum
from functools import wraps
from typing import Any, Literal

from pydantic import BaseModel

from marey_schemas.access import Role
from marey_schemas.base import Answer, Request
from marey_schemas.sizes import MIB
from marey_server.access.roles import STRICTEST, RequiredRole

Method = Callable[..., Awaitable[Any]]
Declared = Callable[..., Coroutine[Any, Any, None]]
"""Function that Tornado calls; it runs the method as declared."""


class Access(StrEnum):
    """Minimum access that an operation requires.

    Values with the name of a role, such as `reader`, require at least this role in the project that the path names.
    """

    ANYONE = "anyone"
    SIGNED_IN = "signed_in"
    USER = "user"
    ADMINISTRATOR = "administrator"
    READER = "reader"
    CONTRIBUTOR = "contributor"
    MAINTAINER = "maintainer"
    OWNER = "owner"
    WORKER = "worker"
    ATTEMPT = "attempt"
    PARTICIPANT = "participant"

    @property
    def role(self) -> Role | None:
        """The role with the same name as this access, or None if there is none."""
        return next((role for role in Role if role.value == self.value), None)


class Document:
    """Marker of a body or an answer that is a document: a tree with arrays, which contains the name of its schema."""


class Bytes:
    """Marker of a body or an answer that consists of plain bytes."""


class Files:
    """Marker of a body that is `multipart/form-data` with files and form fields."""


Content = type[BaseModel] | type[Document] | type[Bytes]


@dataclass(frozen=True, slots=True)
class RequestBody:
    """Body of a request: a model, a document, bytes or files with the form fields `fields`.

    `streamed` bodies are passed to the resource piece by piece while they are received. If `results` is true, the body
    contains results of a job. The arrays in these results may have up to `max_bytes` when decoded. If possible, they
    are stored as they are sent, without decoding.
    """

    content: Content | type[Files]
    max_bytes: int = MIB
    alternative: type[Request] | None = None
    fields: type[Request] | None = None
    streamed: bool = False
    required: bool = True
    results: bool = False


@dataclass(frozen=True, slots=True)
class Operation:
    """Declaration of one method of one resource."""

    method: str
    summary: str
    description: str
    access: Access
    scope: str | None
    query: type[Request] | None
    body: RequestBody | None
    answer: Content | None
    status: int
    paged: bool
    etag: bool
    precondition: Literal["none", "required", "create", "optional"]
    idempotency: Literal["key", "nature"]
    answer_types: tuple[str, ...]
    also: tuple[tuple[int, type[Answer] | None], ...]
    public: bool
    headers: tuple[str, ...]
    stream: bool
    reserved: bool
    attempts: bool
    """True if running attempts of jobs may use the operation, in addition to the callers that `access` admits."""
    replays: bool
    """True if an attempt of a job may repeat the request after the attempt has ended."""
    in_folders: bool = False
    """True if members who have the declared role only in some folders may use the operation in these folders."""
    names: bool = False
    """True if a change answers with names of the project's content, such as those of conflicts of a merge."""
    for_browsers: bool = False
    """True if people open the address in a browser, so that errors are pages, too."""
    compressed: bool = False
    """True if the body may be compressed with zstd, and the answer is compressed if the caller accepts it."""

    @property
    def required_role(self) -> RequiredRole:
        """The role that the store enforces in every project that this operation uses."""
        role = self.access.role
        if role is None:
            return STRICTEST
        return RequiredRole(role, self.scope or "read", guests=self.public, in_folders=self.in_folders)

    @property
    def stores(self) -> bool:
        """True if the operation stores a request body, which may need much disk space.

        False for `reserved` operations.
        """
        changes = self.access is Access.ATTEMPT or self.scope in ("write", "jobs")
        return changes and self.body is not None and not self.reserved

    @property
    def shows_project(self) -> bool:
        """True if the operation changes a project and shows its content, so that callers need the scope `read`, too."""
        shows = self.etag or self.names
        return self.scope in ("write", "jobs") and self.access.role is not None and shows and self.answer is not None

    @property
    def may_create(self) -> bool:
        """True if the operation accepts `If-None-Match: *`."""
        return self.precondition in ("create", "optional")


_WHO = {
    Access.ANYONE: "Needs no token",
    Access.SIGNED_IN: "Needs a token",
    Access.USER: "Needs the token of a user",
    Access.ADMINISTRATOR: "Only for administrators of the server",
    Access.WORKER: "Only for workers",
    Access.ATTEMPT: "Needs the token of the attempt",
    Access.PARTICIPANT: "Needs the link of a participant of a study",
}


def conditions_of(operation: Operation) -> str:
    """Return sentences about who may use an operation, the effect of repeated requests, and the pages of lists."""
    role = operation.access.role
    who = _WHO[operation.access] if role is None else f"Needs at least the role {role.value} in the project"
    if operation.in_folders:
        who += " or in the folder"
    if operation.scope is not None:
        if operation.access is Access.ANYONE:
            who += f"; a token that is sent needs the scope `{operation.scope}`"
        else:
            who += f", and the scope `{operation.scope}`"
    sentences = [who]
    if role is Role.READER and operation.public:
        sentences.append("In public projects, no token is needed")
    if operation.precondition == "required":
        sentences.append("The header If-Match must contain the ETag that you read, or `*`")
    if operation.precondition == "create":
        sentences.append("Send If-Match with the ETag that you read, or `If-None-Match: *` to create the resource")
    if operation.idempotency == "key":
        sentences.append("With Idempotency-Key, a repeated request gets the same answer")
    if operation.compressed:
        sentences.append("Body and answer may be compressed (`Content-Encoding: zstd`, `Accept-Encoding: zstd`)")
    if operation.paged:
        sentences.append("The answer is one page; to get the next page, send its `next_cursor` as `cursor`")
    return " ".join(f"{one}." for one in sentences)


def reads(
    *,
    access: Access,
    query: type[Request] | None = None,
    body: Content | RequestBody | None = None,
    answer: Content | None = None,
    paged: bool = False,
    etag: bool = False,
    scope: str | None = "read",
    status: int = 200,
    answer_types: tuple[str, ...] = (),
    also: tuple[tuple[int, type[Answer] | None], ...] = (),
    public: bool = True,
    headers: tuple[str, ...] = (),
    stream: bool = False,
    reserved: bool = False,
    attempts: bool = False,
    for_browsers: bool = False,
    compressed: bool = False,
) -> Callable[[Method], Declared]:
    """Declare a method that changes nothing.

    Parameters
    ----------
    body : model of a body that contains the query, for queries that may be too long for a URL
    answer : type of the answer, or, with `paged`, of one element of a page
    answer_types : media types of the answer, if they differ from those of models and documents
    also : further statuses, each with the type of its answer
    public : whether guests of a public project may use the method
    headers : request headers that the method reads
    stream : whether the answer is also available as server-sent events
    reserved : whether the method runs in threads that are kept free for such methods
    attempts : whether running attempts of jobs may use the method
    for_browsers : whether errors are answered with pages, because people open the address in a browser
    compressed : whether the body and the answer may be compressed with zstd
    """
    return _declare(
        access=access, scope=scope, query=query, body=body, answer=answer, paged=paged, etag=etag, status=status,
        answer_types=answer_types, also=also, public=public, headers=headers, stream=stream, reserved=reserved,
        attempts=attempts, for_browsers=for_browsers, compressed=compressed,
    )  # fmt: skip


def writes(
    *,
    access: Access,
    body: Content | RequestBody | None = None,
    answer: Content | None = None,
    status: int | None = None,
    query: type[Request] | None = None,
    precondition: Literal["none", "required", "create", "optional"] = "none",
    idempotency: Literal["key", "nature"] = "nature",
    etag: bool = False,
    scope: str | None = "write",
    also: tuple[tuple[int, type[Answer] | None], ...] = (),
    headers: tuple[str, ...] = (),
    reserved: bool = False,
    attempts: bool = False,
    replays: bool = False,
    in_folders: bool = False,
    names: bool = False,
    compressed: bool = False,
) -> Callable[[Method], Declared]:
    """Declare a method that changes something.

    Parameters
    ----------
    access : minimum access, but not `Access.READER`, because readers may not change a project
    precondition : `required` demands If-Match; `create` demands If-Match or `If-None-Match: *`; `optional` accepts both
    idempotency : `key` accepts Idempotency-Key; `nature` means that a repeated request has no further effect
    answer, also, headers, reserved, attempts, compressed : as for `reads`
    replays : whether an attempt of a job may repeat the request after the attempt has ended
    in_folders : whether members who have the role only in some folders may use the method in these folders; the
        function that the method calls must check the role in the folder
    names : whether the answer names content of the project, such as the conflicts of a merge; then callers need the
        scope `read`, too, as they do for an answer with an ETag
    """
    if access is Access.READER:
        raise TypeError("A method that changes a project requires at least the role contributor.")
    return _declare(
        access=access, scope=scope, query=query, body=body, answer=answer,
        status=status or (200 if answer else 204), precondition=precondition, idempotency=idempotency,
        etag=etag, also=also, headers=headers, reserved=reserved, attempts=attempts,
        replays=replays, in_folders=in_folders, names=names, compressed=compressed,
    )  # fmt: skip


def _declare(
    *,
    access: Access,
    scope: str | None,
    query: type[Request] | None,
    answer: Content | None,
    status: int,
    etag: bool,
    also: tuple[tuple[int, type[Answer] | None], ...],
    body: Content | RequestBody | None = None,
    paged: bool = False,
    precondition: Literal["none", "required", "create", "optional"] = "none",
    idempotency: Literal["key", "nature"] = "nature",
    answer_types: tuple[str, ...] = (),
    public: bool = True,
    headers: tuple[str, ...] = (),
    stream: bool = False,
    reserved: bool = False,
    attempts: bool = False,
    replays: bool = False,
    in_folders: bool = False,
    names: bool = False,
    for_browsers: bool = False,
    compressed: bool = False,
) -> Callable[[Method], Declared]:
    def attach(method: Method) -> Declared:
        @wraps(method)
        async def perform(self: Any, **_path: str) -> None:
            await self.perform(method)

        summary, _, description = (inspect.getdoc(method) or "").partition("\n")
        taken = body if body is None or isinstance(body, RequestBody) else RequestBody(body)
        perform.operation = Operation(  # pyrefly: ignore[missing-attribute]  # read by `Resource`
            method.__name__.upper(), summary.rstrip("."), description.strip(), access, scope, query, taken, answer,
            status, paged, etag, precondition, idempotency, answer_types, also, public, headers, stream, reserved,
            attempts, replays, in_folders, names, for_browsers, compressed,
        )  # fmt: skip
        return perform

    return attach
