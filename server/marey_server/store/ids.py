"""Ids: opaque, sortable by time of creation, prefixed by type, never reused."""

import re
import secrets
import time

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_ID = re.compile(f"[a-z_-]{{1,13}}_[{_ALPHABET}]{{26}}")
_ID_IN_TEXT = re.compile(rf"\b[a-z]+_[{_ALPHABET}]{{26}}\b")


def new_id(prefix: str) -> str:
    """Create an id like `clip_01k9m3...`: 48 bits of time in milliseconds and 80 random bits in Crockford's base 32."""
    return _id_of(prefix, (time.time_ns() // 1_000_000) << 80 | secrets.randbits(80))


def first_id_at(prefix: str, time_us: int) -> str:
    """Return an id that sorts before all ids of the millisecond of `time_us` or later, and after all earlier ids."""
    return _id_of(prefix, max(time_us, 0) // 1000 << 80)


def _id_of(prefix: str, number: int) -> str:
    digits = [_ALPHABET[(number >> shift) & 31] for shift in range(125, -1, -5)]
    return f"{prefix}_{''.join(digits)}"


def ids_in(text: str) -> list[str]:
    """Return the ids of items, jobs and so on that a text contains, in order."""
    return _ID_IN_TEXT.findall(text)


def is_id(text: str) -> bool:
    """Return whether a text has the form of an id."""
    return _ID.fullmatch(text) is not None
