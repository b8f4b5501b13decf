"""Commands of edits in the form `trim start=10`: parsed, written as text, and described with their parameters."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.typed_values import Schema, parameters_of, read_value, type_text
from marey_schemas.wording import suggestion

if TYPE_CHECKING:
    from pydantic import BaseModel

JSON_PARAMETER = re.compile(r"(?<!\S)[a-z_]+=(?=[\[{])")
"""Pattern of the name and the equals sign of a parameter whose value begins with `[` or `{`, as JSON does."""


def parse_command(text: str) -> dict[str, Any]:
    """Return a command with its parameters. Raises `WrongUsage`, which lists the valid commands or parameters."""
    from marey_schemas.editing.edits import COMMAND_MODELS

    name, *assigned = _words(text) or [""]
    if name not in COMMAND_MODELS:
        raise WrongUsage(f"there is no command {name!r}; {suggestion(name, COMMAND_MODELS, 'commands')}")
    parameters = _parameters(COMMAND_MODELS[name])
    command: dict[str, Any] = {"command": name}
    for assignment in assigned:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise WrongUsage(f"{name}: {assignment!r} is not a parameter with a value; write parameter=value")
        if key not in parameters:
            raise WrongUsage(f"{name} has no parameter {key!r}; it has {', '.join(parameters) or 'none'}")
        command[key] = read_value(value, parameters[key])
    return command


def _words(text: str) -> list[str]:
    """Split a command at spaces. Lists and objects in JSON keep their quotes; elsewhere, quotes are as in a shell."""
    words: list[str] = []
    begin = 0
    while found := JSON_PARAMETER.search(text, begin):
        words += _shell_words(text[begin : found.start()])
        try:
            _, begin = json.JSONDecoder().raw_decode(text, found.end())
        except (ValueError, RecursionError) as error:
            raise WrongUsage(
                f"{text[found.start() :]!r} is not a parameter with a value in JSON ({error}); "
                """write for example constraints=[{"kind":"position","joint":"left_wrist"}]"""
            ) from None
        words.append(text[found.start() : begin])
    return words + _shell_words(text[begin:])


def _shell_words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise WrongUsage(
            f"{text!r} cannot be read as a command ({error}); write a command and its parameters, as in 'trim start=10'"
        ) from None


def command_text(command: dict[str, Any]) -> str:
    """Return a command as text that `parse_command` reads."""
    values = (f"{name}={_value_text(value)}" for name, value in command.items() if name != "command")
    return " ".join((command["command"], *map(_quoted, values)))


def _quoted(text: str) -> str:
    """Quote a text so that `_words` reads it as one word.

    Only double quotes are added, because people put single quotes around whole commands.
    """
    if JSON_PARAMETER.match(text) or shlex.quote(text) == text:
        return text
    name, _, value = text.partition("=")
    escaped = value.replace("\\", r"\\").replace('"', r"\"")
    return f'{name}="{escaped}"'


def _value_text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list) and value and all(_is_plain(one) for one in value):
        return ",".join(map(str, value))
    return json.dumps(value, separators=(",", ":"))


def _is_plain(value: Any) -> bool:
    return value.isalnum() if isinstance(value, str) else isinstance(value, int | float) and not isinstance(value, bool)


# -- descriptions --


def parameter_rows(model: type[BaseModel]) -> Iterator[tuple[str, str, str, str]]:
    """Return name, type, default and description of each parameter of a command."""
    return _rows(_parameters(model), model.model_json_schema().get("required", ()))


def object_types(model: type[BaseModel]) -> Iterator[tuple[str, Iterator[tuple[str, str, str, str]]]]:
    """Return the types of objects in list parameters of a command, each as a heading and the rows of its fields."""
    for name, schema in _parameters(model).items():
        for choice in schema.get("anyOf", (schema,)):
            items = choice.get("items", {})
            for one in items.get("oneOf", (items,)):
                if "properties" in one:
                    kind = one["properties"].get("kind", {}).get("const")
                    heading = f"{name}, kind {kind}" if kind else name
                    yield f"{heading}: {one['description']}", _rows(one["properties"], one["required"])


def _rows(parameters: dict[str, Schema], required: list[str]) -> Iterator[tuple[str, str, str, str]]:
    for name, schema in parameters.items():
        default = "required" if name in required else json.dumps(schema.get("default"))
        yield name, type_text(schema), default, schema.get("description", "")


def _parameters(model: type[BaseModel]) -> dict[str, Schema]:
    """Return the schema of each parameter of a command, by name."""
    return {name: schema for name, schema in parameters_of(model).items() if name != "command"}
