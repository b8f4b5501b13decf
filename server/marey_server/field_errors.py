"""Conversion of pydantic's validation errors to field errors.

A field error consists of a JSON Pointer into the request, a code and a text.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from marey_schemas.problems import FieldError
from marey_schemas.validation.faults import steps_in, telling_faults
from marey_schemas.validation.reasons import plain_reason

MAX_ERRORS = 50
"""Greatest number of errors that are returned."""
MOST_READ = 1000
"""Greatest number of pydantic's errors among which those are chosen; a byte of a request can cause several."""


def json_pointer(steps: Sequence[str]) -> str:
    """Return the JSON Pointer (RFC 6901) of a path of keys and indices."""
    return "".join("/" + step.replace("~", "~0").replace("/", "~1") for step in steps)


def field_errors(
    error: ValidationError, model: type[BaseModel], tree: Any, pointer: Callable[[list[str]], str] = json_pointer
) -> list[FieldError]:
    """Return the first `MAX_ERRORS` validation errors of `tree`, which was validated by `model`.

    `pointer` converts the location of an error to text.

    pydantic counts only the valid items of a list. So if an item is invalid, pydantic may also report that the list is
    too short. Such a report is left out.
    """
    entries = telling_faults(tree, error.errors(include_url=False)[:MOST_READ])
    wrong = {entry["loc"][:length] for entry in entries for length in range(len(entry["loc"]))}
    entries = [entry for entry in entries if entry["type"] != "too_short" or entry["loc"] not in wrong]
    found = {
        (pointer(steps_in(tree, entry)), plain_reason(entry, model)): entry["type"].replace("_", "-")
        for entry in entries[:MAX_ERRORS]
    }
    return [FieldError(pointer=place, code=code, detail=reason) for (place, reason), code in found.items()]
