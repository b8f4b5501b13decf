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

    If a value fits none of several types, one error has the reasons of all of them; the code belongs to the first.

    pydantic counts only the valid items of a list. So if an item is invalid, pydantic may also report that the list is
    too short. Such a report is left out.
    """
    entries = telling_faults(tree, error.errors(include_url=False)[:MOST_READ])
    wrong = {entry["loc"][:length] for entry in entries for length in range(len(entry["loc"]))}
    entries = [entry for entry in entries if entry["type"] != "too_short" or entry["loc"] not in wrong]
    found: dict[tuple[str, bool], dict[str, str]] = {}
    for entry in entries[:MAX_ERRORS]:
        of_key = entry["loc"][-1:] == ("[key]",)  # a name in an object; its value can have a fault, too
        reasons = found.setdefault((pointer(steps_in(tree, entry)), of_key), {})
        reasons.setdefault(plain_reason(entry, model), entry["type"].replace("_", "-"))
    return [
        FieldError(pointer=place, code=next(iter(reasons.values())), detail="; or ".join(reasons))
        for (place, _), reasons in found.items()
    ]
