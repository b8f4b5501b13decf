"""Values on the command line or in JSON files, parsed and described by a JSON Schema."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marey_client.cli.terminal.failures import WrongUsage

if TYPE_CHECKING:
    from pydantic import BaseModel

Schema = Mapping[str, Any]

STANDARD_INPUT = "-"
MOST_DIGITS = 18
"""Greatest number of digits of a frame number, which is sent as a 64-bit integer."""
MOST_VALUES = 200
"""Greatest number of values in a range if the schema sets no limit."""
EVEN = 1e-9
_HYPHENATED = re.compile(r"\d+-\d+")
GREATEST_SHOWN_BOUND = 1e15
"""Absolute value from which a bound is not shown, because such bounds are limits of integers, not of a parameter."""


# -- schemas --


def parameters_of(model: type[BaseModel]) -> dict[str, Schema]:
    """Return the JSON Schema of each field of a model, by name; references are replaced by their targets."""
    return resolved(model.model_json_schema())


def resolved(schema: Schema) -> dict[str, Schema]:
    """Return the schema of each property of an object, by name; references are replaced by their targets."""
    definitions = schema.get("$defs", {})
    return {name: _resolved(one, definitions) for name, one in schema.get("properties", {}).items()}


def _resolved(schema: Any, definitions: Mapping[str, Any]) -> Any:
    if isinstance(schema, dict):
        if "$ref" in schema:
            beside = {key: value for key, value in schema.items() if key != "$ref"}
            return {**_resolved(definitions[schema["$ref"].rpartition("/")[2]], definitions), **beside}
        return {key: _resolved(value, definitions) for key, value in schema.items()}
    return [_resolved(one, definitions) for one in schema] if isinstance(schema, list) else schema


def _choices(schema: Schema) -> Sequence[Schema]:
    choices: Sequence[Schema] = schema.get("anyOf", (schema,))
    return choices


def _takes(schema: Schema, kind: str) -> bool:
    return any(one.get("type") == kind or (kind == "string" and "enum" in one) for one in _choices(schema))


def without_null(schema: Schema) -> Schema:
    """Return the schema of a value without the alternative null, if exactly one other alternative remains."""
    others = [one for one in _choices(schema) if one.get("type") != "null"]
    return schema if len(others) == len(_choices(schema)) or len(others) > 1 else others[0]


def type_text(schema: Schema) -> str:
    """Return a short name for the type of a value."""
    names = []
    for one in _choices(schema):
        if "const" in one or "enum" in one:
            names.append(" or ".join(map(str, one.get("enum", (one.get("const"),)))))
        elif one.get("type") == "array":
            inner = type_text((one.get("prefixItems") or [one.get("items", {})])[0])
            names.append(f"list of {inner}s" if inner.endswith(("number", "object")) else f"list of {inner}")
        elif "oneOf" in one:
            names.append("object")
        elif one.get("type") != "null":
            names.append(
                {"integer": "whole number", "string": "text", "boolean": "true or false"}.get(
                    str(one.get("type")), str(one.get("type", "value"))
                )
            )
    return " or ".join(dict.fromkeys(names))


def range_text(schema: Schema) -> str:
    """Return the range of a number, or of the numbers in a list or an object; empty if there is none."""
    of = without_null(schema.get("items") or schema.get("additionalProperties") or schema)
    if "minimum" in of and "maximum" in of:
        return f"{_number_text(of['minimum'])} to {_number_text(of['maximum'])}"
    words = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    bounds = {word: of[name] for name, word in words.items() if abs(of.get(name, inf)) < GREATEST_SHOWN_BOUND}
    return ", ".join(f"{word} {_number_text(bound)}" for word, bound in bounds.items())


def default_text(schema: Schema) -> str:
    """Return a default in the syntax of the command line; empty if it is missing, null, false or an object."""
    default = schema.get("default")
    if isinstance(default, bool):
        return "on" if default else ""
    if isinstance(default, int | float):
        return _number_text(default)
    if isinstance(default, list):
        return _list_text(default)
    return "" if isinstance(default, dict) else str(default or "")


def _number_text(number: float) -> str:
    return f"{number:.0f}" if number == round(number) else f"{number:.4g}"


def _list_text(values: Sequence[Any]) -> str:
    """Return equally spaced numbers as first:last:step, other values as a,b,c."""
    if len(values) > 3 and all(isinstance(value, float) for value in values):
        step = values[1] - values[0]
        if all(abs(after - before - step) < EVEN for before, after in pairwise(values)):
            return f"{values[0]:g}:{values[-1]:g}:{step:g}"
    return ",".join(_number_text(value) if isinstance(value, float) else str(value) for value in values)


# -- values --


def json_or_text(text: str) -> Any:
    """Return a text parsed as JSON, or unchanged if it is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def is_frame(text: str) -> bool:
    """Return whether a text is a frame number."""
    return text.isdecimal() and len(text) <= MOST_DIGITS


def assignment(text: str) -> tuple[str, str]:
    """Parse `name=value`; return the name and the value. Raises `WrongUsage` for other texts."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise WrongUsage(f"{text!r} is not a name with a value; write name=value")
    return name, value


def read_value(text: str, schema: Schema) -> Any:
    """Parse a text as a value of the schema's type; lists are JSON or `1,2,3`, ranges of frames are `10:200`.

    Raises `WrongUsage` for a range of frames with a hyphen.
    """
    if _takes(schema, "null") and text == "null":
        return None
    if _takes(schema, "string"):
        return text
    if not _takes(schema, "array"):
        return json_or_text(text)
    if text.startswith("["):
        return json_or_text(text)
    bounds = text.split(":")
    if len(bounds) == 2 and all(not bound or is_frame(bound) for bound in bounds):
        return [int(bounds[0] or 0), int(bounds[1]) if bounds[1] else None]
    if _HYPHENATED.fullmatch(text) and any("prefixItems" in one for one in _choices(schema)):
        raise WrongUsage(f"{text!r} is not a range of frames; write first:stop, as in {text.replace('-', ':')}")
    of_text = any(one.get("items", {}).get("type") == "string" for one in _choices(schema))
    return [one if of_text else json_or_text(one) for one in text.split(",")]


def read_parameter(text: str, schema: Schema | None) -> Any:
    """Return a text parsed as JSON; unchanged if the schema only allows text."""
    value = json_or_text(text)
    only_text = schema is not None and all(one.get("type") == "string" for one in _choices(schema))
    return text if only_text and not isinstance(value, str) else value


def read_number(text: str, given: str) -> float:
    """Parse a number. Raises `WrongUsage`; its text begins with `given`, the option or argument that was typed."""
    try:
        return float(text)
    except ValueError:
        raise WrongUsage(f"{given}: {text!r} is not a number") from None


def named_number(text: str, names: Mapping[str, Any] | None = None) -> tuple[str, float]:
    """Parse `name=number`. Raises `WrongUsage` for other texts, and for a name that is not in `names`."""
    name, equals, value = text.rpartition("=")
    known = "" if names is None else f"; the names are {', '.join(names)}"
    if not (name and equals):
        raise WrongUsage(f"{text!r} does not have the form name=number{known}")
    if names is not None and name not in names:
        raise WrongUsage(f"{text!r} begins with an unknown name{known}")
    return name, read_number(value, repr(text))


def read_numbers(text: str, most: int | None = None) -> list[float]:
    """Return the values of a range `1:3:0.25`, including the last one, or of a list `1,2,3`.

    Raises `WrongUsage` if the text has another form, or if the range has more than `most` values.
    """
    try:
        numbers = [float(part) for part in text.replace(",", ":").split(":")]
    except ValueError:
        raise WrongUsage(
            f"{text!r} is not a list of numbers; write a range first:last:step, as in 1:3:0.25, "
            "or values, as in 1,1.5,2"
        ) from None
    if not all(map(isfinite, numbers)):
        raise WrongUsage(f"{text!r}: all values must be finite")
    if ":" not in text:
        return numbers
    if "," in text or len(numbers) != 3:
        raise WrongUsage(f"{text!r}: a range is first:last:step, as in 1:3:0.25")
    first, last, step = numbers
    if not (step > 0 and last >= first):
        raise WrongUsage(f"{text!r}: in a range first:last:step, last must be at least first and step above 0")
    most = most or MOST_VALUES
    steps = (last - first) / step + EVEN
    if steps >= most:
        raise WrongUsage(f"{text!r}: the range has more than {most} values; use a larger step or a shorter range")
    return [first + index * step for index in range(int(steps) + 1)]


# -- files --


def read_json(file: Path | str) -> Any:
    """Read JSON from a file, or from standard input for `-`. Raises `WrongUsage` if that fails."""
    data = _read(str(file))
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise WrongUsage(f"{_named(file)} is not text in UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise WrongUsage(f"{_named(file)} is not JSON: {error}") from None


def _read(file: str) -> bytes:
    try:
        if file != STANDARD_INPUT:
            return Path(file).read_bytes()
        if sys.stdin is None:
            raise WrongUsage("standard input is closed, so `-` cannot be read; name a file")
        return sys.stdin.buffer.read()
    except OSError as error:
        raise WrongUsage(f"{_named(file)} cannot be read: {error.strerror or error}") from None


def _named(file: Path | str) -> str:
    return "standard input" if str(file) == STANDARD_INPUT else str(file)
