"""Entity tags and preconditions (RFC 9110, section 13).

A tag is `"<state>.<form>"`: the state of a resource, and the form (media type) in which it was sent. If the resource
can be changed, the state begins with the `rev` of the resource. If the resource is described by a model, a dot and a
digest of the answer follow, because the answer can change without a new `rev`. Examples: the caller gets another role,
a job publishes facets, a folder above an item is moved, or a deleted branch is created again with the same name.

Preconditions of writes compare only the `rev`. So a resource that was read as MessagePack can be changed with JSON, and
a client that knows only the `rev` can send it. If-Match also accepts a tag of a deleted resource if the new resource of
the same name has the same `rev`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from marey_server.errors import BadRequestProblem, PreconditionFailedProblem, PreconditionRequiredProblem
from marey_server.store.revs import ExpectedRev

MOST_STATES = 100
"""Greatest number of tags in If-Match; each tag becomes a parameter of the SQL statement that writes."""

_TAG = re.compile(r'\s*(W/)?"([\x21\x23-\x7e\x80-\xff]*)"\s*')
_REV = re.compile("[0-9]{1,9}")


@dataclass(frozen=True, slots=True)
class Precondition:
    """Precondition of a write: the resource is in one of the given states, in any state (`*`), or does not exist."""

    expected_rev: ExpectedRev = None
    """The `rev` that the UPDATE requires, or a set of revs of which it requires one; None for any state."""
    absent: bool = False


ANY_STATE = Precondition()
"""Precondition that every state meets, for `If-Match: *` and for requests without preconditions."""

ABSENT = Precondition(absent=True)
"""Precondition of the header `If-None-Match: *`, which allows only creation."""


def entity_tag(state: int | str, form: str) -> str:
    """Return the value of the header ETag for a state of a resource that is sent in the form `form`, such as `json`."""
    return f'"{state}.{form}"'


def without_digest(tag: str) -> str:
    """Return an entity tag without the digest of the answer that it may contain."""
    rev, *_, form = tag.strip('"').split(".")
    return entity_tag(rev, form)


def parse_tags(header: str) -> list[str]:
    """Return the values of a list of entity tags without quotation marks, weak or strong; `["*"]` for `*`.

    Raises `BadRequestProblem` if the list is malformed or empty.
    """
    if header.strip() == "*":
        return ["*"]
    tags: list[str] = []
    position = 0
    while position < len(header):
        match = _TAG.match(header, position)
        if match is None:
            raise BadRequestProblem(
                f'Entity tags must be in quotation marks, as in "7.json"; the header has: {header[:200]}'
            )
        tags.append(match[2])
        position = match.end()
        if position < len(header) and header[position] != ",":
            raise BadRequestProblem(f"Entity tags in a header must be separated by commas: {header[:200]}")
        position += 1
    if not tags:
        raise BadRequestProblem(
            "The header If-Match or If-None-Match contains no entity tag; send the ETag of the resource, or *."
        )
    return tags


def matches(if_none_match: str | None, tag: str) -> bool:
    """Return whether If-None-Match contains `tag`, so that the answer is 304."""
    if not if_none_match:
        return False
    held = parse_tags(if_none_match)
    return held == ["*"] or tag.strip('"') in held


def write_precondition(if_match: str | None, if_none_match: str | None, *, may_create: bool = False) -> Precondition:
    """Return the precondition of a write, from the headers If-Match and If-None-Match.

    Raises `PreconditionRequiredProblem` if the request has no precondition. Raises `BadRequestProblem` if the tags are
    malformed or too many, or if If-None-Match of a request that may create the resource is not `*`. Raises
    `PreconditionFailedProblem` if no tag begins with the `rev` of a resource.
    """
    if if_none_match is not None and may_create:
        if if_none_match.strip() != "*":
            raise BadRequestProblem(
                "In a request that creates a resource, If-None-Match must be *, so that an existing "
                "resource is not replaced."
            )
        return ABSENT
    if if_match is None:
        hint = "If-Match with the ETag you read, or *" + (", or If-None-Match: * to create" if may_create else "")
        raise PreconditionRequiredProblem(f"Name the version of the resource that you want to change: send {hint}.")
    tags = parse_tags(if_match)
    if tags == ["*"]:
        return ANY_STATE
    revs = sorted({int(rev) for tag in tags if _REV.fullmatch(rev := tag.partition(".")[0])})
    if not revs:
        raise PreconditionFailedProblem(
            f"If-Match contains no ETag of this resource: {if_match[:200]}. Read the resource again, and send its ETag."
        )
    if len(revs) > MOST_STATES:
        raise BadRequestProblem(f"If-Match names {len(revs)} versions; at most {MOST_STATES} are allowed.")
    return Precondition(revs[0] if len(revs) == 1 else frozenset(revs))
