"""Place in a trace, as the header `traceparent` of W3C Trace Context transmits it."""

from __future__ import annotations

import re
import secrets
from dataclasses import dataclass

HEADER = "traceparent"
_FORM = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-[!-~]{0,200})?")
_SAMPLED = 1


@dataclass(frozen=True, slots=True)
class TraceContext:
    """Id of a trace, id of one of its spans, and whether the spans of the trace are recorded (sampled).

    `span_id` is 0 at the beginning of a trace, which has no span yet.
    """

    trace_id: int
    span_id: int
    sampled: bool

    @classmethod
    def parse(cls, header: str | None) -> TraceContext | None:
        """Return the context that a header contains, or None if the header is missing or malformed.

        Versions of the format after 00 may append fields, which are ignored.
        """
        match = _FORM.fullmatch(header) if header is not None else None
        if match is None or match[1] == "ff" or (match[1] == "00" and match[5] is not None):
            return None
        trace_id, span_id, flags = int(match[2], 16), int(match[3], 16), int(match[4], 16)
        return cls(trace_id, span_id, bool(flags & _SAMPLED)) if trace_id and span_id else None

    @property
    def header(self) -> str:
        """The context as the value of the header `traceparent`."""
        return f"00-{self.shown_trace}-{self.span_id:016x}-{self.sampled:02x}"

    @property
    def shown_trace(self) -> str:
        """The id of the trace as 32 hexadecimal digits, as logs and collectors show it."""
        return f"{self.trace_id:032x}"

    def within(self, span_id: int) -> TraceContext:
        """Return the same trace at another span."""
        return TraceContext(self.trace_id, span_id, self.sampled)


def new_trace_id() -> int:
    """Return a random id for a trace."""
    return secrets.randbits(128) or 1


def new_span_id() -> int:
    """Return a random id for a span."""
    return secrets.randbits(64) or 1
