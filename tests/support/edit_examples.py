"""Examples of all commands of an edit, as documents, for the generated walks of `edited_takes`."""

from typing import Any

from marey_schemas.editing.edits import COMMAND_MODELS


def examples_of(name: str) -> list[dict[str, Any]]:
    """Return the examples of one command."""
    return [{"command": name, **given} for given in COMMAND_MODELS[name].examples]


def commands_of_all() -> list[dict[str, Any]]:
    """Return the examples of all commands."""
    return [example for name in COMMAND_MODELS for example in examples_of(name)]
