"""The two bases of every document that travels."""

from pydantic import BaseModel, ConfigDict


class Request(BaseModel):
    """What a caller sends. Unknown fields are refused, so that a misspelt option is never ignored silently."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True
    )


class Answer(BaseModel):
    """What a server answers. Unknown fields are ignored, so that older clients survive additions."""

    model_config = ConfigDict(
        extra="ignore", frozen=True, arbitrary_types_allowed=True, populate_by_name=True, serialize_by_alias=True
    )
