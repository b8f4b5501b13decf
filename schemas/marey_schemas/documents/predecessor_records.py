"""Records of work with Marey's predecessor: documents that have no other form in Marey."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.documents.originals import StoredOriginal
from marey_schemas.names import form

RecordForm = Literal["job", "transform run", "edit history", "synthesis input"]
MOST_SHOWN = 1000
"""Greatest number of fields of a record that are shown."""
LONGEST_TEXT = 1000
"""Greatest number of characters of a field that are shown."""
HIDDEN = "(not shown: a credential)"
"""Text that is shown in place of a credential."""

FieldPointer = Annotated[
    str,
    StringConstraints(
        pattern=form(r"^(?:/|$)", "be a JSON Pointer, which begins with a slash"), max_length=LONGEST_TEXT
    ),
]
FieldValue = Annotated[str, StringConstraints(max_length=LONGEST_TEXT)] | bool | int | float | None


class PredecessorRecord(Request):
    """Part `record`: a document of Marey's predecessor, which Marey stores and exports unchanged.

    Marey does not carry out the work that the document describes. `fields` contains the values that are shown to
    people; `original` refers to the file with the document.
    """

    schema_: Literal["marey/predecessor-record@1"] = Field("marey/predecessor-record@1", alias="schema")
    form: RecordForm = Field(description="Kind of work that the document records.")
    fields: dict[FieldPointer, FieldValue] = Field(
        default_factory=dict,
        max_length=MOST_SHOWN,
        description="Values by their JSON Pointers in the document. Credentials are hidden, and long texts are cut "
        "off.",
    )
    fields_left_out: int = Field(0, ge=0, description="Number of further values, which are only in the file.")
    original: StoredOriginal = Field(description="The imported file.")
