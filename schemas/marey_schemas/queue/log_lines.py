"""Format of log lines of the server and its workers: JSON for collectors, text for people."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

LogForm = Literal["json", "text"]

_FIELDS = (
    "request_id", "trace_id", "principal", "method", "route", "status", "duration_ms", "bytes_in", "bytes_out",
    "remote", "job",
)  # fmt: skip


class JsonFormatter(logging.Formatter):
    """Formatter of a log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a log record as one line of JSON."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {name: value for name in _FIELDS if (value := getattr(record, name, None)) is not None}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class TextFormatter(logging.Formatter):
    """Formatter of a log record as a line of text, which a traceback follows if there is one."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(name)s: %(message)s", datefmt="%H:%M:%S")

    def format(self, record: logging.LogRecord) -> str:
        """Return a log record as text; the ids of its request and of its trace are at the end, if there are any."""
        line = super().format(record)
        given = [one for name in ("request_id", "trace_id") if (one := getattr(record, name, None))]
        return f"{line} [{' '.join(given)}]" if given else line


def usual_form() -> LogForm:
    """Return the default form: text if standard error is a terminal, else JSON."""
    return "text" if sys.stderr is not None and sys.stderr.isatty() else "json"


def log_to_standard_error(form: LogForm, level: str) -> None:
    """Send every log record of the process to standard error, in one form."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
