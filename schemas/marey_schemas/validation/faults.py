"""Selection of the faults that help a person most, and their places in the document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from marey_schemas.wording import one_of

_OF_FITTING_TYPE = frozenset(("value_error", "assertion_error"))
"""Kinds of faults that a validator of ours found in a value whose type is right."""


def telling_faults(document: Any, faults: Sequence[Any]) -> list[Any]:
    """Return the faults that help a person, those of unknown fields first.

    `faults` are the entries of `ValidationError.errors()`. For a value that can have several types, pydantic reports
    what each of the types would need. Only the faults of the type that the value resembles most are returned; if it
    resembles several types equally, the faults that these have in common, or all of them if they have none in common.
    If each of them lacks another field, one fault names these fields.
    """
    order = {fault["loc"]: index for index, fault in reversed(list(enumerate(faults)))}
    for index, fault in enumerate(faults):
        for length in range(len(fault["loc"])):  # the places of faults that name the fields that types lack
            order.setdefault(fault["loc"][:length], index)
    return misspelt_first(sorted(_likely_faults(document, faults, 0), key=lambda one: order[one["loc"]]))


def misspelt_first(faults: Sequence[Any]) -> list[Any]:
    """Sort faults that pydantic found: faults of unknown fields come first.

    If a required field is misspelt, pydantic reports an unknown field and a missing one; the unknown one says more.
    """
    return sorted(faults, key=lambda one: one["type"] != "extra_forbidden")


def steps_in(document: Any, fault: Mapping[str, Any]) -> list[str]:
    """Return the steps of a fault's place that exist in the document; the last step may be a missing field.

    The other steps are left out; they are names that pydantic gives to the types of a union.
    """
    place, steps = fault["loc"], []
    for index, step in enumerate(place):
        if _has(document, step):
            document = document[step]
        elif not _is_missing_field(document, fault, index):
            continue
        steps.append(str(step))
    return steps


def _has(document: Any, step: int | str) -> bool:
    try:
        document[step]
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _is_missing_field(document: Any, fault: Mapping[str, Any], index: int) -> bool:
    return fault["type"] == "missing" and index == len(fault["loc"]) - 1 and isinstance(document, Mapping)


def _likely_faults(document: Any, faults: Sequence[Any], depth: int) -> list[Any]:
    """Select faults in `document`, which lies at the first `depth` steps of their places."""
    found: list[Any] = []
    fields: dict[Any, list[Any]] = {}
    types: dict[Any, list[Any]] = {}
    for fault in faults:
        if depth == len(fault["loc"]) or _is_missing_field(document, fault, depth):
            found.append(fault)
        else:
            step = fault["loc"][depth]
            (fields if _has(document, step) else types).setdefault(step, []).append(fault)
    for step, inner in fields.items():
        found += _likely_faults(document[step], inner, depth + 1)
    return found + _of_likeliest_type([_likely_faults(document, inner, depth + 1) for inner in types.values()], depth)


def _of_likeliest_type(types: Sequence[list[Any]], depth: int) -> list[Any]:
    """Return the faults of the type with the fewest faults; a type that does not fit the value at all comes last."""

    def unlikeness(faults: list[Any]) -> tuple[bool, int]:
        other = any(len(one["loc"]) == depth + 1 and one["type"] not in _OF_FITTING_TYPE for one in faults)
        return other, len(faults)

    least = min(map(unlikeness, types), default=None)
    likeliest = [faults for faults in types if unlikeness(faults) == least]
    alike = [{_identity(one, depth) for one in faults} for faults in likeliest]
    common = set.intersection(*alike) if alike else set()
    if common:
        return [one for one in likeliest[0] if _identity(one, depth) in common]
    lacking = [
        one for faults in likeliest for one in faults if one["type"] == "missing" and len(one["loc"]) == depth + 2
    ]
    if len(lacking) == len(likeliest) == sum(map(len, likeliest)) > 1:
        return [_lacking_one_of(lacking, depth)]
    return [one for faults in likeliest for one in faults]


def _lacking_one_of(lacking: Sequence[Any], depth: int) -> Any:
    """Return the fault of an object that needs one of several fields, from the faults about each of the fields."""
    fields = one_of([repr(one["loc"][-1]) for one in lacking])
    return {**lacking[0], "type": "value_error", "loc": lacking[0]["loc"][:depth], "msg": f"Value error, give {fields}"}


def _identity(fault: Mapping[str, Any], depth: int) -> tuple[Any, ...]:
    return fault["type"], fault["loc"][depth + 1 :], fault["msg"] if fault["type"] in _OF_FITTING_TYPE else ""
