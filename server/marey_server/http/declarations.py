"""Declarations of handler methods.

`@reads` and `@writes` attach an `Operation` to a method. Everything else follows from it: checks before the method
runs, the OpenAPI document, the documentation page, and the table that the access test walks through.
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
from marey_server.access.roles import STRICTEST, RequiredRole

KIB = 1024
MIB = 1024 * KIB

Method = Callable[..., Awaitable[Any]]
Declared = Callable[..., Coroutine[Any, Any, None]]
"""What Tornado calls: it performs the method as its declaration says."""


class Access(StrEnum):
    """Least access for an operation. Roles are roles in the project of the path, including every higher role."""

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

    @property
    def role(self) -> Role | None:
        """The role in a project, or None where it is none."""
        return next((role for role in Role if role.value == self.value), None)


class Document:
    """Marks a body or an answer that is a document: a tree with arrays, of the schema it names."""


class Bytes:
    """Marker of a body or an answer that consists of plain bytes."""


class Files:
    """Marks a body that is `multipart/form-data` with files and form fields."""


Content = type[BaseModel] | type[Document] | type[Bytes]


@dataclass(frozen=True, slots=True)
class RequestBody:
    """A body that a method takes: a model, a document, bytes or files.

    `streamed` bodies are given to the resource piece by piece, as they come.
    """

    content: Content | type[Files]
    max_bytes: int = MIB
    alternative: type[Request] | None = None
    streamed: bool = False
    required: bool = True


@dataclass(frozen=True, slots=True)
class Operation:
    """One method of one resource, as declared."""

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

    @property
    def required_role(self) -> RequiredRole:
        """The role that the store enforces in every project which this operation touches."""
        role = self.access.role
        return STRICTEST if role is None else RequiredRole(role, self.scope or "read", guests=self.public)

    @property
    def may_create(self) -> bool:
        """Whether `If-None-Match: *` is a precondition of it."""
        return self.precondition in ("create", "optional")


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
) -> Callable[[Method], Declared]:
    """Declare a method that changes nothing.

    `answer` is what one answer holds, or with `paged` one element of a page; `answer_types` are the media types where
    they are not those of models and documents. `stream`: it also comes as server-sent events. `public=False`: guests of
    a public project may not. `also` are further statuses, `headers` further request headers. With a `body`, it is a
    question too long for an address.
    """
    return _declare(
        access=access, scope=scope, query=query, body=body, answer=answer, paged=paged, etag=etag, status=status,
        answer_types=answer_types, also=also, public=public, headers=headers, stream=stream,
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
) -> Callable[[Method], Declared]:
    """Declare a method that changes something.

    `precondition`: `required` demands If-Match; `create` demands If-Match or `If-None-Match: *`; `optional` takes
    either or none. `idempotency="key"`: honours Idempotency-Key; `nature`: doing it twice does it once anyway.
    Readers and guests of a project change nothing in it, so `access` cannot be that of readers.
    """
    if access is Access.READER:
        raise TypeError("A method that changes a project requires at least the role contributor.")
    return _declare(
        access=access, scope=scope, query=query, body=body, answer=answer,
        status=status or (200 if answer else 204), precondition=precondition, idempotency=idempotency,
        etag=etag, also=also, headers=headers,
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
) -> Callable[[Method], Declared]:
    def attach(method: Method) -> Declared:
        @wraps(method)
        async def perform(self: Any, **_path: str) -> None:
            await self.perform(method)

        summary, _, description = (inspect.getdoc(method) or "").partition("\n")
        taken = body if body is None or isinstance(body, RequestBody) else RequestBody(body)
        perform.operation = Operation(  # type: ignore[attr-defined]
            method.__name__.upper(), summary.rstrip("."), description.strip(), access, scope, query, taken, answer,
            status, paged, etag, precondition, idempotency, answer_types, also, public, headers, stream,
        )  # fmt: skip
        return perform

    return attach
