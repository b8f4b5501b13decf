"""Arguments that accept one value or several: a text is one name, and a dict is one document."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel


def several(given: str | Path | Mapping[str, Any] | BaseModel | Iterable[Any]) -> tuple[Any, ...]:
    """Return one value or several as a tuple; a text, a path, a document or a model is one value."""
    return (given,) if isinstance(given, (str, Path, Mapping, BaseModel)) else tuple(given)
