"""The `marey` command. Modules of this package import large libraries only when a command runs."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from marey_client.cli.terminal.failures import INTERRUPTED

GLOBAL_SWITCHES = ("-v", "--verbose")
GLOBAL_OPTIONS = ("--server", "--token-file")


def main() -> None:
    """Run the command line and exit: 0 success, 1 refused or failed, 2 wrong usage, 130 interrupted."""
    try:
        _run()
    except KeyboardInterrupt:  # also of who is impatient while modules load
        sys.exit(INTERRUPTED)
    except RuntimeError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        sys.exit(INTERRUPTED)  # until Python 3.11, an exception in `__set_name__` of a class gets this wrapping


def _run() -> None:
    from marey_client.cli.app import with_one_command
    from marey_client.cli.terminal.failures import reported

    _take_any_text()
    if os.environ.get("_MAREY_COMPLETE", "").startswith("complete_"):
        _complete()
    arguments = with_global_options_first(sys.argv[1:])
    with reported(verbose=any(switch in arguments for switch in GLOBAL_SWITCHES)):
        with_one_command(_command_name(arguments))(args=arguments, prog_name="marey")


def _complete() -> NoReturn:
    """Print suggestions for a shell that requests completion, and exit; see `marey_client.cli.completion`."""
    from marey_client.cli.app import with_one_command
    from marey_client.cli.completion.running import answer_shell

    sys.exit(answer_shell(with_one_command, apart_from_global_options))


def _command_name(arguments: list[str]) -> str | None:
    """Return the first argument that is neither a global option nor the value of one; None if there is none."""
    left = iter(arguments)
    for argument in left:
        if argument in GLOBAL_OPTIONS:
            next(left, None)
        elif argument not in GLOBAL_SWITCHES and not argument.startswith(tuple(f"{name}=" for name in GLOBAL_OPTIONS)):
            return argument
    return None


def _take_any_text() -> None:
    """Make output streams escape characters that their encoding lacks; discard output if the process has no stream."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - open to the end
        getattr(sys, name).reconfigure(errors="backslashreplace")


def with_global_options_first(arguments: list[str]) -> list[str]:
    """Return the arguments with the global options first, where typer needs them.

    Users can therefore also write global options after the command, as in `marey ls lab --server URL`.
    """
    first, rest = apart_from_global_options(arguments)
    return first + rest


def apart_from_global_options(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return the global options with their values, and all other arguments."""
    first: list[str] = []
    rest: list[str] = []
    left = iter(arguments)
    for argument in left:
        if argument == "--":
            rest += [argument, *left]
        elif argument in GLOBAL_SWITCHES or argument.startswith(tuple(f"{name}=" for name in GLOBAL_OPTIONS)):
            first.append(argument)
        elif argument in GLOBAL_OPTIONS:
            first += [argument, *([value] if (value := next(left, None)) is not None else [])]
        else:
            rest.append(argument)
    return first, rest
