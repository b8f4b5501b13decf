"""Quoting: how shells read the words of a line, and how suggestions are written so that shells read them as text.

Names on the server are chosen by other people, so a suggestion must never become anything but text: no second command,
no substitution, and no repetition of an earlier command by `!`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

_PLAIN_IN_BASH = "_-./,+%@:="
_ENDS_A_COMMAND = ";|&<>()"
_EXPANDS = "$`"


class Mark(NamedTuple):
    """Character of a line, and how a POSIX shell reads it."""

    place: int
    typed: str
    plain: str
    """What it contributes to the word: nothing if it is a quote, or a backslash before another character."""
    quote: str
    """Quote in which the next character stands, or the empty text."""
    is_free: bool
    """Whether it is neither quoted nor escaped nor a quote."""
    is_escaped: bool
    """Whether a backslash is before it and escapes it."""


def marks(text: str) -> Iterator[Mark]:
    """Yield how a POSIX shell reads each character; a quote that is still open ends with the text."""
    quote, escaped = "", False
    for place, one in enumerate(text):
        free, after_backslash = False, escaped
        if escaped:
            escaped, plain = False, one
        elif one == "\\" and quote != "'" and (not quote or text[place + 1 : place + 2] in ("", *'"\\$`')):
            escaped, plain = True, ""
        elif one == quote or (not quote and one in "'\""):
            quote, plain = "" if quote else one, ""
        else:
            plain, free = one, not quote
        yield Mark(place, one, plain, quote, free, after_backslash)


def for_bash(text: str, raw: str, replaced: str) -> str | None:
    """Return what bash inserts for a suggestion, or None if it is not certain that bash would read it as text.

    `raw` is the word as typed up to the cursor; `replaced` is its end, which bash replaces. If a quote is open, this is
    the text after the quote, otherwise the word or its part from a character such as `=` on.
    """
    if not raw.endswith(replaced) or any(_is_expanded(mark) for mark in marks(raw)):
        return None
    kept = raw[: len(raw) - len(replaced)]
    before = "".join(mark.plain for mark in marks(kept))
    quote, quote_kept = _open_quote(raw), _open_quote(kept)
    if quote != quote_kept or (quote and not kept.endswith(quote)) or not text.startswith(before):
        return None
    shown = text[len(before) :]
    return _in_quote(shown, quote) if quote else _with_backslashes(shown)


def for_powershell(text: str, remark: str) -> str | None:
    """Return a line for typer's script for PowerShell, or None if the script would cut the text."""
    if ":::" in text:
        return None
    safe = all(one.isascii() and (one.isalnum() or one in "_-./=:") for one in text)
    # PowerShell takes curved quotes for straight ones. Its list needs a remark.
    quoted = text if safe else f"'{''.join(one * 2 if one in _QUOTES_OF_POWERSHELL else one for one in text)}'"
    return f"{quoted}:::{remark or text}"


_QUOTES_OF_POWERSHELL = "'\u2018\u2019\u201a\u201b"


def _is_expanded(mark: Mark) -> bool:
    """Return whether bash might replace this character by something else, or end the command there."""
    if mark.typed in _EXPANDS:
        return mark.quote != "'" and not mark.is_escaped
    return mark.is_free and mark.typed in _ENDS_A_COMMAND


def _open_quote(text: str) -> str:
    quote = ""
    for mark in marks(text):
        quote = mark.quote
    return quote


def _with_backslashes(text: str) -> str:
    plain = (one.isalnum() or one in _PLAIN_IN_BASH or not one.isascii() for one in text)
    return "".join(one if safe else f"\\{one}" for one, safe in zip(text, plain, strict=True))


def _in_quote(text: str, quote: str) -> str:
    """Return text for the inside of a quote that is open; bash closes the quote after a single suggestion.

    bash omits a quote from the beginning of a suggestion if one is before it already, and closes no quote after a
    suggestion that ends with one. So there is a further quote in both cases.
    """
    shown = "".join(_one_in_quote(one, quote) for one in text)
    begin = quote if shown.startswith(quote) else ""
    return f"{begin}{shown}{quote if shown.endswith(quote) else ''}"


def _one_in_quote(one: str, quote: str) -> str:
    if quote == "'":
        return "'\\''" if one == "'" else one
    if one == "!":
        return '"\\!"'  # in double quotes, bash would repeat an earlier command; a backslash there would stay
    return f"\\{one}" if one in '"\\$`' else one
