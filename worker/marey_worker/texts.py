"""Conversion of texts in the requests of a worker to a form that the server accepts."""

from __future__ import annotations


def storable(text: str, most: int) -> str:
    """Return a text that every database can store, shortened to at most `most` characters.

    NUL and lone surrogates, which occur in names of files that are not valid UTF-8, are written as escape sequences.
    """
    clean = text.encode(errors="backslashreplace").decode().replace("\0", "\\x00")
    return clean if len(clean) <= most else f"{clean[: most - 1]}…"
