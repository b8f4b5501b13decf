"""Conversion of pydantic's validation errors to field errors.

A field error consists of a JSON Pointer into the request, a code and a text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from marey_schemas.problems import FieldError
from marey_schemas.wording import plain_reason

MAX_ERRORS = 50


def json_pointer(steps: Sequence[str]) -> str:
    """Return the JSON Pointer (RFC 6901) of a path of keys and indices."""
    return "".join("/" + step.replace("~", "~0").replace("/", "~1") for step in steps)


def field_errors(
    error: ValidationError, tree: Any, pointer: Callable[[list[str]], str] = json_pointer
) -> list[FieldError]:
    """Return the first `MAX_ERRORS` validation errors of `tree`; `pointer` converts the location of an error to text.

    pydantic counts only the valid items of a list. So if an item is invalid, pydantic may also report that the list is
    too short. Such a report is left out.
    """
    entries = error.errors(include_url=False, include_context=False, include_input=False)
    wrong = {entry["loc"][:length] for entry in entries for length in range(len(entry["loc"]))}
    entries = [entry for entry in entries if entry["type"] != "too_short" or entry["loc"] not in wrong]
    return [
        FieldError(
            pointer=pointer(_steps(entry["loc"], tree, may_lack_last=entry["type"] == "missing")),
            code=entry["type"].replace("_", "-"),
            detail=plain_reason(entry["msg"]),
        )
        for entry in entries[:MAX_ERRORS]
    ]


def _steps(location: tuple[int | str, ...], tree: Any, *, may_lack_last: bool) -> list[str]:
    """Return the steps of an error's location that exist in the document; the last step may be a missing field.

    The other steps are left out: they are names of union members, which pydantic inserts.
    """
    steps = []
    for index, step in enumerate(location):
        try:
            tree = tree[step]
        except (KeyError, IndexError, TypeError):
            if not (may_lack_last and index == len(location) - 1 and isinstance(tree, Mapping)):
                continue
        steps.append(str(step))
    return steps
