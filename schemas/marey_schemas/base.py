"""Base classes of requests, answers and options."""

from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, SerializerFunctionWrapHandler, model_serializer


class Request(BaseModel):
    """Base of requests. Unknown fields are refused, so that a misspelt option is never ignored silently."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True,
        hide_input_in_errors=True,  # a traceback must not print a password
        defer_build=True,  # validators are built at their first use: a process uses few of the 400 models
    )  # fmt: skip


class Answer(BaseModel):
    """Base of answers. Unknown fields are ignored, so that older clients work with servers that add fields."""

    model_config = ConfigDict(
        extra="ignore", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True,
        defer_build=True,  # see `Request`
    )  # fmt: skip


class Options(Request):
    """Base of the options of a computation.

    Subclasses declare the type, range, default and description of each option. The parameters of a job embed or extend
    these classes, and functions of `marey_motion` accept instances of them. A value out of range raises
    `pydantic.ValidationError`, which names the field. Instances are frozen, and hashable if their values are.
    """

    @classmethod
    def of(cls, extended: BaseModel) -> Self:
        """Return an instance whose values are taken from `extended`, which must have all fields of this class."""
        return cls(**{name: getattr(extended, name) for name in cls.model_fields})

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which the fields named in `changes` have new values; the copy is validated."""
        return type(self)(**{**dict(self), **changes})


def require_tag(schema: dict[str, Any], model: type[Any]) -> None:
    """Add the tag field of the `Tagged` class `model` to the required properties of its JSON Schema."""
    schema["required"] = list(dict.fromkeys((model.tag, *schema.get("required", ()))))


class Tagged(Options):
    """Base of alternative classes of options. The value of one field, the tag, identifies the class.

    `tag` is the name of this field. Documents must contain the field. In Python the field may be omitted, because its
    default is the value that identifies the class.
    """

    model_config = ConfigDict(json_schema_extra=require_tag)
    tag: ClassVar[str]

    @model_serializer(mode="wrap")
    def _with_tag(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Include the tag even in documents that omit default values or unset fields."""
        return {**serialise(self), self.tag: getattr(self, self.tag)}
