"""Passwords and codes, read from the terminal without echo or from standard input, never from the command line."""

from __future__ import annotations

import sys

import typer

from marey_client.cli.terminal.failures import WrongUsage


def ask_secret(what: str, *, twice: bool = False) -> str:
    """Return a text typed at the terminal without echo; without a terminal, the next line of standard input."""
    if sys.stdin.isatty():
        return str(typer.prompt(what, hide_input=True, confirmation_prompt=twice, err=True))
    if secret := sys.stdin.readline().rstrip("\r\n"):
        return secret
    raise WrongUsage(
        f"nothing was given for “{what}”: standard input is not a terminal and contains no line of text; run the "
        "command in a terminal"
    )
