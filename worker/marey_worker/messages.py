"""Messages between a worker's supervisor process and its child process, through a pipe.

The child never gets a token or an address.

A message is MessagePack: the name of its class and its fields, which the receiver validates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import msgpack
from pydantic import TypeAdapter

from marey_schemas.items import PartPlace
from marey_schemas.kinds import Kind
from marey_schemas.processes.child_process import BadMessage
from marey_schemas.queue.jobs import Progress
from marey_schemas.queue.worker_protocol import PinnedInput

# From the supervisor


@dataclass(frozen=True)
class Run:
    """Message that asks a child process to run a job."""

    job: str
    kind: str
    params: Mapping[str, Any]
    inputs: Mapping[str, tuple[PinnedInput, ...]]
    seed: int
    memory_limit_bytes: int
    log_path: Path
    scratch: Path
    threads: int
    position: int | None = None
    size: int | None = None
    into: str = ""


@dataclass(frozen=True)
class ChildReply:
    """Answer to a request: the requested value, or the reason why the request failed.

    `missing` is true if the requested object does not exist. `too_large` is true if it is too large for the job's
    memory limit.
    """

    request: int
    value: Any = None
    refusal: str | None = None
    missing: bool = False
    too_large: bool = False


# From the child


@dataclass(frozen=True)
class ReadParts:
    """Request for parts of revisions.

    The answer contains an encoded document for each part, or None if it does not exist. It may omit documents at the
    end of a long list, but not the first one.
    """

    request: int
    places: tuple[PartPlace, ...]


@dataclass(frozen=True)
class ReadItem:
    """Request for an item at its newest revision."""

    request: int
    kind: Kind
    item: str


@dataclass(frozen=True)
class FindItems:
    """Request for the items with a name in one folder, or in the whole project if `collection` is None."""

    request: int
    kind: Kind
    name: str
    collection: str | None


@dataclass(frozen=True)
class ReadBlob:
    """Request for a blob by digest."""

    request: int
    digest: str


@dataclass(frozen=True)
class ReadResults:
    """Request for the results of the job's tasks."""

    request: int


@dataclass(frozen=True)
class ReadJudgements:
    """Request for the answers of the participants who saw a revision of a study.

    The reply has one document for each participant.
    """

    request: int
    item: str
    revision: int


@dataclass(frozen=True)
class PutFile:
    """Request to send a file to the server; the answer is the digest of the file."""

    request: int
    path: Path


@dataclass(frozen=True)
class Stage:
    """Request to stage outputs, given as an encoded `StageRequest`."""

    request: int
    body: bytes


@dataclass(frozen=True)
class ProgressMade:
    """Message that reports the progress of the job."""

    progress: Progress


@dataclass(frozen=True)
class Done:
    """Message that the job has computed all its results; the last results may not be stored yet.

    `shareable` is false if the results depend on more than the kind, parameters, seed and inputs of the job.
    """

    result: dict[str, Any]
    shareable: bool = True


BAD_RESULT = "bad-result"
"""Code of `Failed` if a result contains a value that no request can contain, such as a NaN."""


@dataclass(frozen=True)
class Failed:
    """Message that the job has failed: code and text of the reason, signature, and whether a retry may succeed."""

    code: str
    detail: str
    signature: str | None
    retryable: bool


Request = ReadParts | ReadItem | FindItems | ReadBlob | ReadResults | ReadJudgements | PutFile | Stage
End = Done | Failed

_FORMS = {
    one.__name__: TypeAdapter(one)
    for one in (
        Run, ChildReply, ReadParts, ReadItem, FindItems, ReadBlob, ReadResults, ReadJudgements, PutFile, Stage,
        ProgressMade, Done, Failed,
    )
}  # fmt: skip


UNPACKABLE = (TypeError, ValueError, OverflowError)
"""Errors of `pack`, for example for an integer of more than 64 bits."""


def pack(message: Any) -> bytes:
    """Encode a message. Raises one of the errors `UNPACKABLE` for values that cannot be encoded."""
    name = type(message).__name__
    fields = _FORMS[name].dump_python(message, by_alias=True)
    packed: bytes = msgpack.packb([name, fields], default=_plain)
    return packed


def _plain(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, datetime):  # of items, which the child validates
        return value.isoformat()
    raise TypeError(f"a message cannot contain a value of the type {type(value).__name__}")


def unpack(data: bytes) -> Any:
    """Return the message that the bytes contain. Raises `BadMessage` if they contain no valid message."""
    try:
        name, fields = msgpack.unpackb(data, strict_map_key=True)
        return _FORMS[name].validate_python(fields)
    except (ValueError, TypeError, KeyError, msgpack.UnpackException, RecursionError) as error:
        raise BadMessage(f"{len(data)} bytes from another process cannot be read as a message: {error}") from error
