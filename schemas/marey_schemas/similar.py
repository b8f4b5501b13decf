"""Searches by example: moments of a project's clips that resemble a pose or a window of frames."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.references import RevisionRef
from marey_schemas.names import ItemId

MOST_MOMENTS = 100
LONGEST_EXAMPLE_S = 60.0
"""Longest example in seconds."""

_MOST_NUMBER = 2**31 - 1

SearchedMetric = Literal["published/sigmoid", "published/manhattan", "published/euclid"]
FrameNumber = Annotated[int, Field(ge=0, le=_MOST_NUMBER)]


class SimilarOptions(Request):
    """Options of a search by example."""

    results: int = Field(10, ge=1, le=MOST_MOMENTS, description="Greatest number of moments to return.")
    mirrored: bool = Field(
        False, description="Also find moments that resemble the example with left and right exchanged."
    )
    leave_out: Literal["window", "clip", "nothing"] = Field(
        "window",
        description="Which moments of the example's own clip are left out: those that overlap the example, all, or "
        "none.",
    )
    metric: SearchedMetric = Field(
        "published/sigmoid", description="Perceptual metric: the published weights with one of three shapings."
    )
    index: ItemId | None = Field(
        None, description="Id of the index to search; absent: the index of the project that was updated last."
    )


class SimilarRequest(SimilarOptions):
    """Request for the moments that resemble an example."""

    clip: ItemId = Field(description="Id of the clip that contains the example.")
    revision: int | None = Field(None, ge=1, le=_MOST_NUMBER, description="Revision of the clip; absent: the newest.")
    frames: tuple[FrameNumber, FrameNumber] = Field(
        description="Frames of the example: the first, and the one after the last."
    )

    @model_validator(mode="after")
    def _check_frames(self) -> Self:
        first, end = self.frames
        if end <= first:
            raise ValueError(f"frames: the end, frame {end}, must be after the start, frame {first}")
        return self


class SimilarMoment(Answer):
    """Moment of a clip that resembles the example."""

    clip: ItemId
    revision: int
    path: str = Field(description="Folder and name of the clip.")
    frames: tuple[int, int] = Field(description="The first frame, and the one after the last.")
    start_s: float
    end_s: float
    distance: float = Field(description="Mean perceptual distance of the poses, without unit.")
    mirrored: bool = Field(description="Whether the moment resembles the example with left and right exchanged.")


class SimilarAnswer(Answer):
    """Moments that resemble an example, the most similar first; they do not overlap."""

    moments: tuple[SimilarMoment, ...]
    index: RevisionRef = Field(description="The index that was searched.")
    searched_clips: int
    behind: int = Field(
        description="Number of clips that were created or changed since the index was updated, and were not searched."
    )
