"""Parts of sentences: numbers with nouns, lists of names, and messages of validation errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

NAMES_SHOWN = 5
"""Greatest number of names that a message lists."""


_ABOUT_PATTERN = "String should match pattern '"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1: "1 frame", "103,568 trajectories"."""
    if number == 1:
        return f"1 {noun}"
    if noun.endswith("y") and noun[-2] not in "aeou":
        return f"{number:,} {noun[:-1]}ies"
    return f"{number:,} {noun}{'es' if noun.endswith('x') else 's'}"


def part_of(shown: int, total: int, noun: str) -> str:
    """Return how many of all things are shown, for example "8 of 130 takes"; "8 takes" if all of them are shown."""
    return counted(total, noun) if shown == total else f"{shown:,} of {counted(total, noun)}"


def one_of(names: Sequence[str]) -> str:
    """Return the names of a choice as text: "bvh, npz or json"."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most similar to a misspelt name, ignoring case; None if no name is similar."""
    by_lower = {one.lower(): one for one in known}
    near = get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[near[0]] if near else None


def plain_reason(message: str) -> str:
    """Return a message of pydantic for people: without "Value error, ", and with words instead of a pattern."""
    if not message.startswith(_ABOUT_PATTERN):
        return message.removeprefix("Value error, ")
    from marey_schemas.names import FORMS  # with pydantic, which the help of the command line does not load

    pattern = message[len(_ABOUT_PATTERN) : -1]
    return f"the text must {FORMS.get(pattern, 'have another form; it may contain a character that is not allowed')}"


def printable(text: str) -> str:
    """Return a text whose control characters are escaped, except ends of lines.

    Many texts contain parts that other users wrote, and these must not control the terminal of the reader.
    """
    return "".join(one if one.isprintable() or one == "\n" else ascii(one)[1:-1] for one in text)
