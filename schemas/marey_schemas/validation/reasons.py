"""Reasons of validation errors, as sentences for people."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args

from marey_schemas.validation.faults import misspelt_first, steps_in, telling_faults
from marey_schemas.wording import counted, nearest

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

_WITH_CHOICES = re.compile(r"^('.*' is not one of ((?:'[^']*'(?:, )?)+))\.$")
"""Pattern of typer's messages about options with choices."""
_QUOTED = re.compile(r"'([^']*)'")
_BOUNDS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


def plain_reason(fault: Mapping[str, Any], model: type[BaseModel] | None = None) -> str:
    """Return the reason of a fault that pydantic found, as a sentence for people without its first capital letter.

    `fault` is an entry of `ValidationError.errors()`, with its context. With `model`, the model of the whole document,
    the reason of an unknown field names the field that is spelled most like it.
    """
    kind, context = str(fault["type"]), {name: _shown(value) for name, value in fault.get("ctx", {}).items()}
    if kind in ("value_error", "assertion_error"):
        reason = str(fault["msg"]).partition(", ")[2]
        return _WITH_CHOICES.sub(lambda found: f"{found[1]}{_suggestion(fault, _QUOTED.findall(found[2]))}", reason)
    if kind == "string_pattern_mismatch":
        from marey_schemas.names import FORMS  # with pydantic, which the help of the command line does not load

        form = FORMS.get(context["pattern"], "have another form; it may contain a character that is not allowed")
        return f"the text must {form}"
    if kind == "missing" and isinstance(fault["loc"][-1], int):
        return "the list has too few entries"
    if kind == "extra_forbidden":
        known = _fields_at(model, fault["loc"][:-1])
        if fault["loc"][-1] in known:  # a field of another type of a union
            return "this field cannot be combined with the others of this object"
        return f"there is no field of this name{_suggestion(fault, known)}"
    if kind in _BOUNDS and str(fault.get("input")).strip().lower() in ("nan", "+nan", "-nan"):
        kind = "finite_number"  # pydantic compares NaN with a bound before it finds that NaN is not finite
    if kind.endswith(("too_short", "too_long")):
        return _length_reason(kind, fault["ctx"])
    reason = _REASONS.get(kind, "the value does not have the required form").format(**context)
    return reason + _suggestion(fault, _QUOTED.findall(context.get("expected", context.get("expected_tags", ""))))


def first_reason(error: ValidationError, model: type[BaseModel] | None = None, given: Any = None) -> str:
    """Return the first fault of a `ValidationError` in one line: its place and the reason.

    `model` is the validated model, and `given` the document. The steps of the place that the document lacks are left
    out; they are names that pydantic gives to the types of a union.
    """
    faults: dict[str, dict[str, None]] = {}
    found = error.errors(include_url=False)
    for fault in misspelt_first(found) if given is None else telling_faults(given, found):
        steps = list(map(str, fault["loc"])) if given is None else steps_in(given, fault)
        faults.setdefault(".".join(steps), {})[plain_reason(fault, model)] = None
    place, reasons = next(iter(faults.items()))
    return ": ".join(filter(None, (place, "; or ".join(reasons))))  # each type of a union has its own reason


_NUMBER, _WHOLE, _FLAG = (
    "the value must be a number",
    "the value must be a whole number",
    "the value must be true or false",
)
_TEXT, _LIST, _OBJECT = (
    "the value must be text",
    "the value must be a list",
    "the value must be an object with named fields",
)
_DATE, _TIME = "the value must be a date, such as 2026-01-31", "the value must be a time, such as 2026-01-31T12:00:00Z"
_REASONS = {
    "missing": "this field is missing",
    "greater_than": "the value must be above {gt}",
    "greater_than_equal": "the value must be at least {ge}",
    "less_than": "the value must be below {lt}",
    "less_than_equal": "the value must be at most {le}",
    "multiple_of": "the value must be a multiple of {multiple_of}",
    "finite_number": "the value must be a finite number",
    "literal_error": "the value must be {expected}",
    "enum": "the value must be {expected}",
    "union_tag_invalid": "the field {discriminator} must be one of {expected_tags}, not '{tag}'",
    "union_tag_not_found": "the field {discriminator} is missing",
    "none_required": "the value must be null",
    "json_invalid": "the text is not JSON: {error}",
    "timezone_aware": "the time must have a time zone, such as Z or +01:00",
    "string_unicode": "the text is not UTF-8",
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), _WHOLE),
    **dict.fromkeys(("float_type", "float_parsing", "decimal_type", "decimal_parsing"), _NUMBER),
    **dict.fromkeys(("bool_type", "bool_parsing"), _FLAG),
    **dict.fromkeys(("string_type", "string_sub_type", "bytes_type", "path_type"), _TEXT),
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type", "iterable_type"), _LIST),
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type", "mapping_type", "dataclass_type"), _OBJECT),
    **dict.fromkeys(("date_type", "date_parsing", "date_from_datetime_parsing", "date_from_datetime_inexact"), _DATE),
    **dict.fromkeys(("datetime_type", "datetime_parsing", "datetime_from_date_parsing"), _TIME),
}
"""Reasons for people, by pydantic's name of the error; values of the error's context replace the placeholders."""


def _length_reason(kind: str, context: Mapping[str, Any]) -> str:
    what, unit = ("text", "character") if kind.startswith("string") else ("list", "entry")
    if context.get("field_type") == "Dictionary":
        what, unit = "object", "field"
    if kind.endswith("short"):
        least = context["min_length"]
        return (
            f"the {what} must not be empty" if least == 1 else f"the {what} must have at least {counted(least, unit)}"
        )
    return f"the {what} must have at most {counted(context['max_length'], unit)}"


def _shown(value: Any) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _suggestion(fault: Mapping[str, Any], known: Iterable[str]) -> str:
    """Return a text to append to the reason of a fault: a question with the known word that is most similar.

    A number with a decimal comma is repeated with a point instead. The text is empty if no known word is similar.
    """
    typed = fault["loc"][-1] if fault["type"] == "extra_forbidden" else fault.get("ctx", {}).get("tag", fault["input"])
    near = nearest(typed, known) if isinstance(typed, str) else None
    if fault["type"] in ("float_parsing", "int_parsing") and re.fullmatch(r"[-+]?\d+,\d+", str(fault.get("input"))):
        return f", with a decimal point: {str(fault['input']).replace(',', '.')}"
    return f"; did you mean {near!r}?" if near else ""


def _fields_at(model: type[BaseModel] | None, place: Sequence[int | str]) -> list[str]:
    """Return the names of the fields that the objects at a place in a document of `model` can have."""
    found: list[Any] = [] if model is None else [model]
    for step in place:  # steps that are no field are positions in lists, keys, and names of the types of a union
        fields = [one.model_fields[step] for one in found if step in one.model_fields]
        found = [inner for field in fields for inner in _models_in(field.annotation)] or found
    return [field.alias or name for one in found for name, field in one.model_fields.items()]


def _models_in(annotation: Any) -> Iterator[Any]:
    if hasattr(annotation, "model_fields"):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)
