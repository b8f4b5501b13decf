"""Requests and answers of imports."""

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.documents import Check
from marey_schemas.names import CollectionPath, Digest, Tag

FileName = Annotated[str, StringConstraints(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f\x7f]+$")]
"""May hold folders: they become collections below the target."""


class ImportOptions(Request):
    """What the caller knows and the files do not say. Absent: inferred from evidence, or asked for when ambiguous."""

    collection: CollectionPath = Field("", description="Folder of the project that the clips go to.")
    skeleton: str | None = Field(
        None, description="Item id of the skeleton the clips must use; absent: found or created."
    )
    unit: Literal["m", "cm", "mm", "dm", "inch", "ft", "cmu"] | None = Field(
        None, description="Unit of length of the files; cmu is 1/0.45 inch. Absent: inferred."
    )
    unit_scale_m: float | None = Field(None, gt=1e-6, lt=1e3, description="Metres per unit, where no named unit fits.")
    up_axis: Literal["x", "y", "z"] | None = Field(
        None, description="Axis that points up in the files. Absent: inferred."
    )
    frame_rate_hz: float | None = Field(None, gt=0, le=100_000, description="Instead of what the files say.")
    trim_rest_pose: bool = Field(False, description="Drop rest poses at both ends.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of every clip.")
    subject: str | None = Field(None, max_length=255, description="Who moves.")
    licence: str | None = Field(None, max_length=255, description="What the data may be used for.")
    capture_system: str | None = Field(None, max_length=255, description="What recorded it.")


class ImportFile(Request):
    """A file whose bytes the server has already."""

    name: FileName
    blob: Digest


class ImportRequest(ImportOptions):
    """Import files by digest. More than the server's synchronous limit becomes a job (202)."""

    files: tuple[ImportFile, ...] = Field(min_length=1, max_length=1000)


class Refusal(Answer):
    """Why a file was refused."""

    code: str
    detail: str
    line: int | None = None
    joint: str | None = None


class ImportEntry(Answer):
    """What became of one file."""

    name: str
    status: Literal["created", "unchanged", "failed", "companion"]
    item: str | None = None
    revision: int | None = None
    skeleton: str | None = None
    frames: int | None = None
    warnings: tuple[Check, ...] = ()
    error: Refusal | None = None


def skeleton_output(file_name: str) -> str:
    """What an import job calls the skeleton of a file among its outputs; the clip has the file's own name."""
    return f"{file_name}#skeleton"


class ImportAnswer(Answer):
    """One entry per file, in the order sent."""

    entries: tuple[ImportEntry, ...]
