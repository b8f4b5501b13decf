"""Answers of handlers, and functions that encode answers as bytes; the functions can run in any thread.

An answer is made in two steps. `load_content` loads the document of the reply, in the transaction. `render` encodes the
reply after the transaction, because encoding a long document takes longer than loading it, and other requests need the
thread and the connection of the transaction.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from pydantic import BaseModel

from marey_schemas.address import API
from marey_schemas.encoding.codecs import JSON as JSON_NAME
from marey_schemas.encoding.codecs import encode_tree
from marey_schemas.encoding.compression import LEAST_BYTES_COMPRESSED, ZSTD, compress
from marey_schemas.lru import LruCache
from marey_server.http.caching import REVALIDATED
from marey_server.http.etags import entity_tag, matches, without_digest
from marey_server.http.negotiation import MediaType

AnswerCache = LruCache[tuple[str, str], bytes]
"""Cache of rendered documents that never change, by digest and media type.

Reading the same document again only copies bytes to the socket. Permission is not cached: every request asks the store
before it takes a body from here.
"""


MakeTree = Callable[[], Mapping[str, Any]]
"""Function that makes a document from loaded data, without using the database."""


@dataclass(frozen=True, slots=True)
class UnchangingDocument:
    """Document that never changes, identified by its digest.

    `load` reads the document. It is called only if the cache of answers has no encoded form of the document.
    """

    digest: str
    load: Callable[[], Mapping[str, Any]]
    size_bytes: int
    """Memory that the loaded document needs, in bytes."""


@dataclass(frozen=True, slots=True)
class LoadedDocument:
    """Document that was loaded and must still be encoded. A document with a `digest` never changes."""

    make: MakeTree
    size_bytes: int
    """Memory that the loaded data needs, in bytes."""
    digest: str | None = None


Content = BaseModel | Mapping[str, Any] | bytes


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer of a handler: a model, a document tree, bytes with their media type, or nothing.

    The ETag is made from the field `rev`, which is the `rev` of a resource or another text that changes with its state.
    If the content is a model, `render` adds a digest of the answer. `location` is a path below the API's root.
    """

    content: Content | UnchangingDocument | LoadedDocument | None = None
    status: int | None = None
    rev: int | str | None = None
    location: str | None = None
    media_type: str | None = None
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Rendered:
    """Answer as status, headers and bytes."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def worth_compressing(self) -> bool:
        """Whether the body is long enough for compression."""
        return len(self.body) >= LEAST_BYTES_COMPRESSED

    def compressed(self) -> Rendered:
        """Return this answer with its body compressed by zstd."""
        return Rendered(self.status, {**self.headers, "Content-Encoding": ZSTD}, compress(self.body))

    def without_content(self) -> Rendered:
        """Return this answer without its body, for a caller who may make the change, but may not read its result.

        The ETag contains no digest of the body. With a digest, the caller could check guesses of the content.
        """
        headers = {name: value for name, value in self.headers.items() if name != "Content-Type"}
        if "ETag" in headers:
            headers["ETag"] = without_digest(headers["ETag"])
        return Rendered(204, headers, b"")


@dataclass(frozen=True, slots=True)
class AnswerForm:
    """Form of the answer that a request asks for: media type, header If-None-Match, and the status of a success."""

    media: MediaType
    if_none_match: str | None
    status: int


def load_content(reply: Reply, form: AnswerForm, answers: AnswerCache) -> Reply:
    """Load the content of a reply if it is an `UnchangingDocument`, and return the new reply.

    The document is not loaded if the client has it already, or if its encoded form is in `answers`. This function must
    be called in the transaction of the request.
    """
    content = reply.content
    if not isinstance(content, UnchangingDocument):
        return reply
    if reply.rev is not None and matches(form.if_none_match, entity_tag(reply.rev, form.media.form)):
        return replace(reply, content=None)
    cached = answers.get((content.digest, form.media.form))
    if cached is not None:
        return replace(reply, content=cached, media_type=reply.media_type or str(form.media))
    return replace(reply, content=LoadedDocument(partial(_itself, content.load()), content.size_bytes, content.digest))


def _itself(tree: Mapping[str, Any]) -> Mapping[str, Any]:
    return tree


def render(reply: Reply, form: AnswerForm, answers: AnswerCache) -> Rendered:
    """Encode a reply as status, headers and bytes, after `load_content` has loaded its document.

    If the client already has this state in this form, the status is 304 and there is no body. Encoded documents are
    added to `answers`.
    """
    if reply.rev is not None and isinstance(reply.content, BaseModel):
        reply = _with_digest(reply, encode(reply.content, form.media), form.media)
    # Without this header, a cache on the way could keep what it has got for the cookie of a browser.
    headers = {"Vary": "Accept, Accept-Encoding", "Cache-Control": REVALIDATED, **reply.headers}
    if reply.location is not None:
        headers["Location"] = API + reply.location
    if reply.rev is not None:
        headers["ETag"] = entity_tag(reply.rev, form.media.form)
        if matches(form.if_none_match, headers["ETag"]):
            return Rendered(304, headers, b"")
    if reply.content is None:
        return Rendered(reply.status or form.status, headers, b"")
    headers["Content-Type"] = reply.media_type or str(form.media)
    return Rendered(reply.status or form.status, headers, _body(reply.content, form.media, answers))


def _with_digest(reply: Reply, body: bytes, media: MediaType) -> Reply:
    """Return the reply with its encoded model `body` as content, and with a digest of this body in its `rev`."""
    state = f"{reply.rev}.{hashlib.sha256(body).hexdigest()[:16]}"
    return replace(reply, content=body, media_type=reply.media_type or str(media), rev=state)


def _body(content: Content | UnchangingDocument | LoadedDocument, media: MediaType, answers: AnswerCache) -> bytes:
    assert not isinstance(content, UnchangingDocument), "`load_content` is called before a reply is rendered"
    if not isinstance(content, LoadedDocument):
        return encode(content, media)
    body = encode(content.make(), media)
    if content.digest is not None:
        answers.put((content.digest, media.form), body)
    return body


def encode(content: Content, media: MediaType) -> bytes:
    """Return a model or tree encoded in a media type; bytes are returned unchanged."""
    if isinstance(content, bytes):
        return content
    if isinstance(content, BaseModel):
        if media.name == JSON_NAME:
            return content.model_dump_json(by_alias=True).encode()
        content = content.model_dump(mode="json", by_alias=True)
    return encode_tree(content, media.name, arrays=media.arrays)
