"""Messages between supervisor and child over their pipe. The child never sees a token or an address."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marey_schemas.items import PartPlace
from marey_schemas.jobs import Progress
from marey_schemas.kinds import Kind
from marey_schemas.worker_protocol import PinnedInput

# From the supervisor


@dataclass(frozen=True)
class Run:
    """Do this job."""

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
    """The answer to a request: bytes, a digest or nothing; or why it was not carried out."""

    request: int
    value: Any = None
    refusal: str | None = None
    missing: bool = False


# From the child


@dataclass(frozen=True)
class Ready:
    """The child has loaded what it needs to work."""


@dataclass(frozen=True)
class ReadParts:
    """Read parts of revisions: the documents as they travel, None for one that is not there.

    The answer may leave out documents at the end of a long list, never the first one.
    """

    request: int
    places: tuple[PartPlace, ...]


@dataclass(frozen=True)
class ReadItem:
    """Read an item as it is now."""

    request: int
    kind: Kind
    item: str


@dataclass(frozen=True)
class FindItems:
    """Find items by their name, directly in a collection or anywhere in the project."""

    request: int
    kind: Kind
    name: str
    collection: str | None


@dataclass(frozen=True)
class ReadBlob:
    """Read bytes by digest."""

    request: int
    digest: str


@dataclass(frozen=True)
class ReadResults:
    """Read what the tasks of this job returned."""

    request: int


@dataclass(frozen=True)
class PutFile:
    """Send a file; the answer is its digest."""

    request: int
    path: Path


@dataclass(frozen=True)
class Stage:
    """Stage outputs: an encoded `StageRequest`."""

    request: int
    body: bytes


@dataclass(frozen=True)
class Made:
    """Progress of the job."""

    progress: Progress


@dataclass(frozen=True)
class Done:
    """The job is done; everything it staged has been acknowledged."""

    result: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """The job cannot be done."""

    code: str
    detail: str
    signature: str | None
    retryable: bool


Request = ReadParts | ReadItem | FindItems | ReadBlob | ReadResults | PutFile | Stage
End = Done | Failed
