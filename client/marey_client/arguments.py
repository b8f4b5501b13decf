"""Validation of arguments: an invalid value raises `BadArgument`, which names the argument."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from marey_client.errors import BadArgument
from marey_schemas.wording import plain_reason

Model = TypeVar("Model", bound=BaseModel)


def checked(model: type[Model], values: Mapping[str, Any] | None = None, /, **more: Any) -> Model:
    """Return a model with the given field values. Raises `BadArgument`, which names the first invalid field."""
    try:
        return model.model_validate({**(values or {}), **more})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(step) for step in first["loc"])
        text = plain_reason(first["msg"])
        raise BadArgument(f"{where}: {text}" if where else text) from error
