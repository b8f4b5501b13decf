"""Parts of sentences, such as numbers with nouns and lists of names, and texts that are safe to show."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches

NAMES_SHOWN = 5
"""Greatest number of names that a message lists."""
_FORMULA_SIGNS = tuple("=+-@\t\r")
"""Characters at the beginning of a text that make a spreadsheet read the text as a formula."""


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
