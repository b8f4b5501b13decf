"""Index of motions for searches by example: part `index` of an item of the kind `index`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.reports import StoredFile
from marey_schemas.names import ItemId
from marey_schemas.sizes import MOST_INTEGER

MOST_SHARDS = 2000
"""Greatest number of shards (pairs of files with the poses of many clips) of an index: about 1,200 hours of motion."""
_Number = Annotated[int, Field(ge=0, le=MOST_INTEGER)]
INDEX_VERSION = 1
"""Version of the format of shards; a server searches only indexes with this version."""


class IndexShard(Request):
    """Shard of an index: two files with the poses of many clips."""

    clips: StoredFile = Field(description="List of the clips, a `ShardClips` as JSON.")
    poses: StoredFile = Field(description="Features of the poses of the clips in `clips`, one row for each pose.")
    rows: int = Field(ge=1, description="Number of poses.")
    dropped: tuple[_Number, ...] = Field(
        (),
        max_length=100_000,
        description="Positions (from 0), in the list of clips of the shard, of the clips that no longer belong "
        "to the index.",
    )


class MotionIndexDocument(Request):
    """Part `index` of an index: the shards of the index, and the numbers of clips and poses in them."""

    schema_: Literal["marey/motion-index@1"] = Field("marey/motion-index@1", alias="schema")
    version: int = Field(INDEX_VERSION, ge=1, description="Version of the format of the shards.")
    clips: int = Field(ge=0, description="Number of clips in the index.")
    rows: int = Field(ge=0, description="Number of poses of the clips in the index, 30 for each second of motion.")
    left_out: int = Field(0, ge=0, description="Number of clips whose poses cannot be compared; the log names them.")
    shards: tuple[IndexShard, ...] = Field((), max_length=MOST_SHARDS)


class ShardClips(Request):
    """Clips of a shard, in the order of their poses; the lists have equal lengths."""

    items: tuple[ItemId, ...] = Field(description="Ids of the clips.")
    revisions: tuple[_Number, ...] = Field(description="Revisions of the clips.")
    rows: tuple[_Number, ...] = Field(description="Number of poses of each clip, 30 per second.")
    joints: tuple[_Number, ...] = Field(description="Compared joints that each clip has, as a bit mask.")
    frames: tuple[_Number, ...] = Field(description="Number of frames of each clip.")
    rates_hz: tuple[Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)], ...] = Field(
        description="Frames per second of each clip."
    )

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if len({len(getattr(self, name)) for name in type(self).model_fields}) != 1:
            raise ValueError("the lists must have equal lengths, with one value for each clip")
        return self
