"""Fields of release 0.1 that give a length in centimetres."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from marey_schemas.base import Request


def in_centimetres(name: str) -> Any:
    """Return the declaration of a deprecated field of release 0.1: the field `name`, but in centimetres, not metres."""
    return Field(
        None,
        exclude=True,
        json_schema_extra={"deprecated": True},
        description=f"Deprecated: use `{name}`. This field of release 0.1 is in centimetres.",
    )


def read_old_unit(model: Request, name: str, old: str) -> None:
    """Convert the value of the field `old` from centimetres to metres, and move it to the field `name`.

    Raises `ValueError` if both fields are given.
    """
    centimetres = getattr(model, old)
    if centimetres is None:
        return
    if name in model.model_fields_set:
        raise ValueError(f"{old}: this old name was given together with the current name {name}; give only {name}")
    object.__setattr__(model, name, centimetres * 0.01)
    object.__setattr__(model, old, None)
    model.model_fields_set.discard(old)
    model.model_fields_set.add(name)
