"""Commands of `marey` that pages and files of the project name, compared with the command line."""

import functools
import re
from typing import Any

from typer import Context
from typer.main import get_command

from marey_client.cli.app import app


@functools.cache
def commands() -> Any:
    """Return the command line. Building all its commands takes long, and each test process imports this module."""
    return get_command(app)


def unknown_options(words: list[str]) -> set[str]:
    """Return the options that the command in `words`, which follow `marey`, does not have.

    Raises `AssertionError` if there is no such command.
    """
    command = commands()
    rest = list(words)
    of_all = {option: parameter for parameter in command.params for option in parameter.opts}
    known = set(of_all)
    while rest and rest[0] in of_all:  # options before the command's name
        rest = rest[1 if of_all[rest[0]].is_flag else 2 :]
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest.pop(0)]
    if any(of_all[word].is_eager for word in words if word in of_all):
        return set()  # such an option does all that the command does
    assert getattr(command, "invoke_without_command", True), (
        f"no command: {words}"
    )  # of a group that does nothing itself
    known |= {option for one in command.get_params(Context(command)) for option in (*one.opts, *one.secondary_opts)}
    return {word.partition("=")[0] for word in rest if re.match(r"--[a-z]|-[a-z]$", word)} - known
