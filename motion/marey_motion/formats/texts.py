"""Preparation of texts from files for messages: replacement of characters that UTF-8 cannot encode, and shortening."""

from __future__ import annotations

LONGEST_NAME = 80
"""Greatest number of characters of a name in a message."""


def plain_text(text: str) -> str:
    r"""Replace halves of surrogate pairs, which JSON can name but UTF-8 cannot contain.

    Parameters
    ----------
    text : str    the text

    Returns
    -------
    str    the text, with a question mark for each half

    Examples
    --------
    >>> plain_text("walk\ud800")
    'walk?'
    """
    return text.encode("utf-8", "replace").decode()


def cut_text(text: str, longest: int) -> str:
    """Shorten a text to at most `longest` characters, and replace halves of surrogate pairs with question marks.

    Parameters
    ----------
    text : str    the text
    longest : int    greatest number of characters

    Returns
    -------
    str    the text; if it was cut off, its last character is an ellipsis

    Examples
    --------
    >>> cut_text("a long text", 6)
    'a lon…'
    """
    return plain_text(text if len(text) <= longest else f"{text[: longest - 1]}…")


def short_name(name: object) -> str:
    """Shorten a name from a file to at most `LONGEST_NAME` characters, for messages.

    Parameters
    ----------
    name : object    the name; any other value that the file has in its place is converted to text

    Returns
    -------
    str    the name; if it was cut off, its last character is an ellipsis

    Examples
    --------
    >>> short_name("walk_left")
    'walk_left'
    """
    return cut_text(name if isinstance(name, str) else str(name), LONGEST_NAME)
