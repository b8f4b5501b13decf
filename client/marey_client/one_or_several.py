"""Arguments that are one thing or several: a text is one name, not its letters; a document is one, not its keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel


def several(given: str | Path | Mapping[str, Any] | BaseModel | Iterable[Any]) -> tuple[Any, ...]:
    """Return what was given as a tuple; a text, a path, a document or a model is one thing."""
    return (given,) if isinstance(given, str | Path | Mapping | BaseModel) else tuple(given)
