"""Base classes of requests, answers and options."""

from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, SerializerFunctionWrapHandler, model_serializer


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
    """Base of the options of a computation: each option has its type, range, default and description here only.

    Parameters of jobs embed or extend them, and `marey_motion` takes them as they are. A value out of range raises
    `pydantic.ValidationError`, which names the field. Instances are frozen, and hashable if their values are.
    """

    @classmethod
    def of(cls, extended: BaseModel) -> Self:
        """Return these options from a model that extends them, without its other fields."""
        return cls(**{name: getattr(extended, name) for name in cls.model_fields})

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values, which are validated."""
        return type(self)(**{**dict(self), **changes})


def _require_tag(schema: dict[str, Any], model: type[Any]) -> None:
    schema["required"] = list(dict.fromkeys((model.tag, *schema.get("required", ()))))


class Tagged(Options):
    """Options of one of several classes that the value of a field, their tag, distinguishes.

    Documents must contain the tag. In Python it is the default of its class.
    """

    model_config = ConfigDict(json_schema_extra=_require_tag)
    tag: ClassVar[str]

    @model_serializer(mode="wrap")
    def _with_tag(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write the tag also into documents without defaults or without fields that were not set."""
        return {**serialise(self), self.tag: getattr(self, self.tag)}
