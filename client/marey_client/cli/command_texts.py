"""Commands of an edit as people type them: `smooth window_s=0.3 joints=Head,Neck frames=10:200`."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from marey_client.cli.failures import WrongUsage
from marey_client.cli.jobs import json_or_text

if TYPE_CHECKING:
    from pydantic import BaseModel

Schema = Mapping[str, Any]

MOST_DIGITS = 18
"""Of the number of a frame, which is sent as one of 64 bits."""


def parse_command(text: str) -> dict[str, Any]:
    """A command with its parameters. Raises `WrongUsage`, and says what there is, for what no command has."""
    from marey_schemas.editing.edits import COMMAND_MODELS

    try:
        name, *assigned = shlex.split(text) or [""]
    except ValueError as error:
        raise WrongUsage(f"{text!r}: {error}; write a command and its parameters, as in 'trim start=10'") from None
    if name not in COMMAND_MODELS:
        raise WrongUsage(f"there is no command {name!r}; there are {', '.join(COMMAND_MODELS)}")
    parameters = parameters_of(COMMAND_MODELS[name])
    command: dict[str, Any] = {"command": name}
    for assignment in assigned:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise WrongUsage(f"{name}: {assignment!r}: write parameter=value")
        if key not in parameters:
            raise WrongUsage(f"{name} has no parameter {key!r}; it has {', '.join(parameters) or 'none'}")
        command[key] = _value(value, parameters[key])
    return command


def is_frame(text: str) -> bool:
    """Whether somebody has typed the number of a frame."""
    return text.isdecimal() and len(text) <= MOST_DIGITS


def parameters_of(model: type[BaseModel]) -> dict[str, Schema]:
    """JSON Schema of each parameter of a command, by name, with references in it put in place."""
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})
    return {name: _resolved(one, definitions) for name, one in schema["properties"].items() if name != "command"}


def parameter_rows(model: type[BaseModel]) -> Iterator[tuple[str, str, str, str]]:
    """Name, type, default and meaning of each parameter of a command."""
    required = model.model_json_schema().get("required", ())
    for name, schema in parameters_of(model).items():
        default = "required" if name in required else json.dumps(schema.get("default"))
        yield name, _type_of(schema), default, schema.get("description", "")


def _resolved(schema: Any, definitions: Mapping[str, Any]) -> Any:
    if isinstance(schema, dict):
        if "$ref" in schema:
            return _resolved(definitions[schema["$ref"].rpartition("/")[2]], definitions)
        return {key: _resolved(value, definitions) for key, value in schema.items()}
    return [_resolved(one, definitions) for one in schema] if isinstance(schema, list) else schema


def _choices(schema: Schema) -> Sequence[Schema]:
    choices: Sequence[Schema] = schema.get("anyOf", (schema,))
    return choices


def _takes(schema: Schema, kind: str) -> bool:
    return any(one.get("type") == kind or (kind == "string" and "enum" in one) for one in _choices(schema))


def _value(text: str, schema: Schema) -> Any:
    """A value as the schema wants it: text stays text; lists are JSON or written 1,2,3, ranges of frames 10:200."""
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
    of_text = any(one.get("items", {}).get("type") == "string" for one in _choices(schema))
    return [one if of_text else json_or_text(one) for one in text.split(",")]


def _type_of(schema: Schema) -> str:
    """A type in a word or two."""
    names = []
    for one in _choices(schema):
        if "const" in one or "enum" in one:
            names.append(" or ".join(map(str, one.get("enum", (one.get("const"),)))))
        elif one.get("type") == "array":
            inner = one.get("prefixItems") or [one.get("items", {})]
            names.append(f"list of {_type_of(inner[0])}")
        elif one.get("type") != "null":
            names.append(
                {"integer": "whole number", "string": "text", "boolean": "true or false"}.get(
                    str(one.get("type")), str(one.get("type", "value"))
                )
            )
    return " or ".join(dict.fromkeys(names))
