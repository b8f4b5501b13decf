"""Quoting for shells: command lines are parsed as shells do, and suggestions are escaped so that they stay plain text.

Other people choose the names on the server. So the shell must not read a suggestion as anything but text: not as a
second command, as a substitution, or as a repetition of an earlier command by `!`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

_PLAIN_IN_BASH = "_-./,+%@:="
_ENDS_A_COMMAND = ";|&<>()"
_EXPANDS = "$`"


class Mark(NamedTuple):
    """Character of a command line, and the meaning that a POSIX shell gives to the character."""

    place: int
    typed: str
    plain: str
    """The character as part of the word; empty for a quote, and for a backslash that escapes the next character."""
    quote: str
    """Kind of quote that is open after this character, or the empty text."""
    is_free: bool
    """Whether the character is outside of quotes, not escaped, and not a quote or an escaping backslash itself."""
    is_escaped: bool
    """Whether a backslash before the character escapes it."""


def marks(text: str) -> Iterator[Mark]:
    """Yield a `Mark` for each character of a text; a quote may still be open at the end of the text."""
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
    """Return the text that bash inserts for the suggestion `text`; None if bash might not read it as plain text.

    `raw` is the word as typed up to the cursor; `replaced` is the end of `raw` that bash replaces. After an open quote,
    `replaced` is the text after the quote; otherwise, it is the whole word, or the part after a character such as `=`.
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
    """Return a suggestion as typer's script for PowerShell reads it; None if the script would cut the text."""
    if ":::" in text:
        return None
    safe = all(one.isascii() and (one.isalnum() or one in "_-./=:") for one in text)
    # PowerShell takes curved quotes for straight ones. Its list needs a remark.
    quoted = text if safe else f"'{''.join(one * 2 if one in _QUOTES_OF_POWERSHELL else one for one in text)}'"
    return f"{quoted}:::{remark or text}"


_QUOTES_OF_POWERSHELL = "'\u2018\u2019\u201a\u201b"


def _is_expanded(mark: Mark) -> bool:
    """Return whether bash might replace this character by other text, or end the command at this character."""
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
    """Return `text` as a suggestion after an open quote; bash closes the quote if there is only one suggestion.

    bash drops a quote at the beginning of a suggestion, because the open quote is before it, and does not close the
    quote after a suggestion that ends with a quote. A second quote is added in both cases.
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
