"""Confirmation of commands that delete something."""

from __future__ import annotations

import sys

import typer

from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.output import print_message


def ask(question: str, *, otherwise: str) -> None:
    """Ask the user to confirm; if the answer is not yes, print the text `otherwise` and raise `Refused`.

    Raises `WrongUsage` if standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise WrongUsage(
            f"{question} This needs a confirmation, but standard input is not a terminal; confirm with --yes"
        )
    if not typer.confirm(question, err=True):
        print_message(otherwise)
        raise Refused
