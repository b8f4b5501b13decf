"""Files of JSON that a command is given: whatever is wrong with one is said with its name."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from marey_client.cli.failures import WrongUsage

STANDARD_INPUT = "-"


def read_json(file: Path | str) -> Any:
    """What a file holds, or standard input for `-`. Raises `WrongUsage` where that cannot be read, or is no JSON."""
    data = _read(str(file))
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise WrongUsage(f"{_named(file)} is no text in UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise WrongUsage(f"{_named(file)} is no JSON: {error}") from None


def _read(file: str) -> bytes:
    try:
        if file != STANDARD_INPUT:
            return Path(file).read_bytes()
        if sys.stdin is None:
            raise WrongUsage("standard input is closed")
        return sys.stdin.buffer.read()
    except OSError as error:
        raise WrongUsage(f"{_named(file)} cannot be read: {error.strerror or error}") from None


def _named(file: Path | str) -> str:
    return "standard input" if str(file) == STANDARD_INPUT else str(file)
