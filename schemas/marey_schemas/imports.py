"""Requests and answers of imports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import Check
from marey_schemas.names import LINE, Digest
from marey_schemas.options.imports import ImportOptions

FileName = Annotated[str, StringConstraints(min_length=1, max_length=1024, pattern=LINE)]
"""Name of a file; folders in the name become collections below the target collection."""


class ImportFile(Request):
    """File to import; the server already has its bytes."""

    name: FileName
    blob: Digest


class ImportRequest(ImportOptions):
    """Request to import files by digest. If the files are too many or too large, a job imports them (status 202)."""

    files: tuple[ImportFile, ...] = Field(min_length=1, max_length=1000)


class Refusal(Answer):
    """Reason why a file was not imported, for programs (`code`) and for people (`detail`)."""

    code: str
    detail: str
    line: int | None = None
    joint: str | None = None


class ImportEntry(Answer):
    """Result of the import of one file: the item and the revision, or the reason of the refusal."""

    name: str
    status: Literal["created", "unchanged", "failed", "companion"] = Field(
        description="created: the item was created, or a new revision of it if `revision` is greater than 1; "
        "unchanged: the item has the same content already; failed: the file was refused; companion: the file was "
        "read together with another file."
    )
    item: str | None = None
    revision: int | None = None
    skeleton: str | None = None
    skeleton_changed: bool = Field(
        False, description="Whether the new revision has another skeleton than the revision before."
    )
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


class Made(Protocol):
    """Published revision of an item for an imported file, as a protocol of the objects that jobs and the server use."""

    @property
    def item(self) -> str:
        """Id of the item."""

    @property
    def revision(self) -> int:
        """Number of the revision."""

    @property
    def created(self) -> bool:
        """Whether the revision is new."""

    @property
    def skeleton_changed(self) -> bool:
        """Whether the revision before the new one has another skeleton."""


NO_MODEL = "no-model"
"""Code of the refusal of a graph whose models are not in the project."""

SKELETON_DIFFERS = Refusal(
    code="skeleton-differs",
    detail="an item of this name exists with another skeleton; import the file into another folder, or give it a new "
    "revision with the skeleton of this file by --replace (in requests: replace_skeleton=true)",
)
"""Refusal of a file for which nothing is published, because it would change the skeleton of an existing item."""


def published_entry(entry: ImportEntry, made: Mapping[str, Made]) -> ImportEntry:
    """Return the entry of a file that was read, completed with what was published for the file.

    `made` contains the published revisions by the names of their drafts. If `made` does not contain the file, the file
    is refused, because an item of this name has another skeleton. If the file contains only a skeleton, the entry names
    the item of the skeleton. Entries of companions, and of files refused for other reasons, are returned unchanged.
    """
    refused = entry.error is not None and entry.error.code == SKELETON_DIFFERS.code
    if entry.status not in ("created", "unchanged") and not refused:
        return entry
    skeleton = made.get(skeleton_output(entry.name))
    main = made.get(entry.name) or (skeleton if entry.frames is None else None)
    if main is None:
        return entry.model_copy(update={"status": "failed", "error": SKELETON_DIFFERS})
    return entry.model_copy(
        update={
            "status": "created" if main.created else "unchanged",
            "item": main.item,
            "revision": main.revision,
            "skeleton": None if skeleton is None else skeleton.item,
            "skeleton_changed": main.skeleton_changed,
            "error": None,
        }
    )


def published_result(result: Mapping[str, Any], made: Mapping[str, Made]) -> dict[str, Any]:
    """Return the result of an import job after its revisions were published; `made` is as in `published_entry`.

    Its entries are those of `published_entry`, and its numbers of clips and frames those that were stored.
    """
    read = ImportAnswer.model_validate(result).entries
    entries = [published_entry(entry, made) for entry in read]
    stored = [entry for entry in entries if entry.error is None]
    return {
        **result,
        "entries": [entry.model_dump(mode="json", exclude_none=True) for entry in entries],
        "clips": sum(entry.frames is not None for entry in stored),
        "frames": sum(entry.frames or 0 for entry in stored),
    }


class ImportAnswer(Answer):
    """Result of an import: one entry for each file, in the order of the request."""

    entries: tuple[ImportEntry, ...]
