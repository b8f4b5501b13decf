"""Byte ranges of a representation (RFC 9110, section 14): one range; several are answered with the whole."""

from __future__ import annotations

import re
from dataclasses import dataclass

from marey_server.errors import RangeNotSatisfiable

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


@dataclass(frozen=True, slots=True)
class ByteRange:
    """What a caller asked for: from `first` to `last`, or with `first` None the `last` bytes at the end."""

    first: int | None
    last: int | None

    def within(self, size: int) -> tuple[int, int]:
        """Start and stop in a representation of `size` bytes. Raises `RangeNotSatisfiable`."""
        if self.first is None:
            start, stop = max(size - (self.last or 0), 0), size
        else:
            start, stop = self.first, size if self.last is None else min(self.last + 1, size)
        if start >= stop:
            headers = {"Content-Range": f"bytes */{size}"}
            raise RangeNotSatisfiable(f"It has {size} bytes; none of the range is among them.", headers=headers)
        return start, stop


def parse_range(header: str | None, if_range: str | None, etag: str) -> ByteRange | None:
    """The range that is asked for; None for the whole: no range, several, malformed, or of another state."""
    if header is None or (if_range is not None and if_range.strip() != etag):
        return None
    match = _RANGE.fullmatch(header.strip())
    if match is None or not (match[1] or match[2]):
        return None
    first = int(match[1]) if match[1] else None
    last = int(match[2]) if match[2] else None
    if first is not None and last is not None and last < first:
        return None
    return ByteRange(first, last)
