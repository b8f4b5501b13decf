"""Base classes of requests, answers and options."""

from typing import Any, Self

from pydantic import BaseModel, ConfigDict


class Request(BaseModel):
    """Base of requests. Unknown fields are refused, so that a misspelt option is never ignored silently."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True
    )


class Answer(BaseModel):
    """Base of answers. Unknown fields are ignored, so that older clients survive additions."""

    model_config = ConfigDict(
        extra="ignore", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True
    )


class Options(Request):
    """Choices that a computation takes: each with its type, range, default and meaning, declared here alone.

    Parameters of jobs embed or extend them, and `marey_motion` takes them as they are. A value out of range raises
    `pydantic.ValidationError`, which names the field. Instances are frozen, and hashable where their values are.
    """

    @classmethod
    def of(cls, extended: BaseModel) -> Self:
        """Return only these options of a model that extends them."""
        return cls(**{name: getattr(extended, name) for name in cls.model_fields})

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values, which are validated."""
        return type(self)(**{**dict(self), **changes})
