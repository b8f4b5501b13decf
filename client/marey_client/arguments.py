"""Arguments of functions: validation by models, and arguments that accept one value or several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from marey_client.errors import BadArgument
from marey_schemas.wording import first_reason

Model = TypeVar("Model", bound=BaseModel)


def checked(model: type[Model], values: Mapping[str, Any] | None = None, /, **more: Any) -> Model:
    """Return an instance of `model` with these values. Raises `BadArgument`, which names the first invalid field."""
    given = {**(values or {}), **more}
    try:
        return model.model_validate(given)
    except ValidationError as error:
        raise BadArgument(first_reason(error, model, given)) from error


def several(given: str | Path | Mapping[str, Any] | BaseModel | Iterable[Any]) -> tuple[Any, ...]:
    """Return an argument, which is one value or several values, as a tuple of values.

    A text, a path, a document or a pydantic model counts as one value.
    """
    return (given,) if isinstance(given, (str, Path, Mapping, BaseModel)) else tuple(given)
