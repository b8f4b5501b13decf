"""Requests and answers of imports."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import Check
from marey_schemas.names import Digest
from marey_schemas.options.imports import ImportOptions

FileName = Annotated[str, StringConstraints(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f\x7f]+$")]
"""Name of a file; folders in the name become collections below the target collection."""


class ImportFile(Request):
    """File to import; the server already has its bytes."""

    name: FileName
    blob: Digest


class ImportRequest(ImportOptions):
    """Request to import files by digest. If the files are too many or too large, a job imports them (status 202)."""

    files: tuple[ImportFile, ...] = Field(min_length=1, max_length=1000)


class Refusal(Answer):
    """Refusal of a file, with the reason."""

    code: str
    detail: str
    line: int | None = None
    joint: str | None = None


class ImportEntry(Answer):
    """Result of importing one file."""

    name: str
    status: Literal["created", "unchanged", "failed", "companion"]
    item: str | None = None
    revision: int | None = None
    skeleton: str | None = None
    frames: int | None = None
    warnings: tuple[Check, ...] = ()
    error: Refusal | None = None


def refused_entry(name: str, refusal: Refusal) -> ImportEntry:
    """Return the entry of a file that was refused."""
    return ImportEntry(name=name, status="failed", error=refusal)


def skeleton_output(file_name: str) -> str:
    """Return the name that an import job gives to its output with the skeleton of a file.

    The output with the file's clip has the name of the file.
    """
    return f"{file_name}#skeleton"


def notes_output(file_name: str, layer: str) -> str:
    """Return the name that an import job gives to its output with an annotation of a file's clip."""
    return f"{file_name}#notes {layer}"


class ImportAnswer(Answer):
    """One entry per file, in the order sent."""

    entries: tuple[ImportEntry, ...]
