"""Parts of sentences: numbers with nouns, lists of names, and the reasons of validation errors."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, get_args

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

NAMES_SHOWN = 5
"""Greatest number of names that a message lists."""
_WITH_CHOICES = re.compile(r"^('.*' is not one of ((?:'[^']*'(?:, )?)+))\.$")
"""Pattern of typer's messages about options with choices."""
_FORMULA_SIGNS = tuple("=+-@\t\r")
"""Characters at the beginning of a text that make a spreadsheet read the text as a formula."""
_QUOTED = re.compile(r"'([^']*)'")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1: "1 frame", "103,568 trajectories"."""
    if number == 1:
        return f"1 {noun}"
    if noun.endswith("y") and noun[-2] not in "aeou":
        return f"{number:,} {noun[:-1]}ies"
    return f"{number:,} {noun}{'es' if noun.endswith('x') else 's'}"


def part_of(shown: int, total: int, noun: str) -> str:
    """Return a text on how many things are shown, such as "8 of 130 takes", or "8 takes" if all of them are shown."""
    return counted(total, noun) if shown == total else f"{shown:,} of {counted(total, noun)}"


def listed(names: Sequence[str]) -> str:
    """Return names as text; of more than `NAMES_SHOWN` names, the first ones and the number of the others."""
    more = len(names) - NAMES_SHOWN
    return ", ".join(names[:NAMES_SHOWN]) + (f" and {more:,} more" if more > 0 else "")


def one_of(names: Sequence[str]) -> str:
    """Return the names of a choice as text: "bvh, npz or json"."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most similar to a misspelt name, ignoring case; None if no name is similar."""
    by_lower = {one.lower(): one for one in known}
    near = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.65)
    return by_lower[near[0]] if near else None


def suggestion(name: str, known: Collection[str], what: str) -> str:
    """Ask whether the nearest known name was meant; if no known name is similar, list all of them.

    `what` is the noun of the known names in the plural, such as "kinds".
    """
    near = nearest(name, known)
    return f"did you mean '{near}'?" if near else f"the {what} are {', '.join(known)}"


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
        return f"there is no field of this name{_suggestion(fault, _fields_at(model, fault['loc'][:-1]))}"
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
    for fault in misspelt_first(error.errors(include_url=False)):
        steps = list(map(str, fault["loc"])) if given is None else steps_in(given, fault)
        faults.setdefault(".".join(steps), {})[plain_reason(fault, model)] = None
    place, reasons = next(iter(faults.items()))
    return ": ".join(filter(None, (place, "; or ".join(reasons))))  # each type of a union has its own reason


def misspelt_first(faults: Sequence[Any]) -> list[Any]:
    """Sort faults that pydantic found: faults of unknown fields come first.

    If a required field is misspelt, pydantic reports an unknown field and a missing one; the unknown one says more.
    """
    return sorted(faults, key=lambda one: one["type"] != "extra_forbidden")


def steps_in(document: Any, fault: Mapping[str, Any]) -> list[str]:
    """Return the steps of a fault's place that exist in the document; the last step may be a missing field.

    The other steps are left out: they are names of union members, which pydantic inserts.
    """
    place, steps = fault["loc"], []
    for index, step in enumerate(place):
        try:
            document = document[step]
        except (KeyError, IndexError, TypeError):
            may_lack = fault["type"] == "missing" and index == len(place) - 1 and isinstance(document, Mapping)
            if not may_lack:
                continue
        steps.append(str(step))
    return steps


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
    **dict.fromkeys(("string_type", "string_sub_type", "bytes_type"), _TEXT),
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


def printable(text: str) -> str:
    """Return a text whose control characters are escaped, except ends of lines.

    Many texts contain parts that other users wrote, and these must not control the terminal of the reader.
    """
    return "".join(one if one.isprintable() or one == "\n" else ascii(one)[1:-1] for one in text)


def without_formula(text: str) -> str:
    """Return a text for a cell of a CSV table, with an apostrophe before a text that looks like a formula.

    Many texts in tables are names that other users wrote, and these must not compute anything in a spreadsheet.
    """
    return f"'{text}" if text.startswith(_FORMULA_SIGNS) else text
