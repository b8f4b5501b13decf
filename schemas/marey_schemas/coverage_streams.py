"""Coverage while a performer records: a stream of frames in, what is still missing out.

Ground positions are metres, headings radians about +Y, 0 towards +z and growing to the left.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import ItemId, JointName
from marey_schemas.options.evaluation import Grid, Speed, TurnRate

LEAST_FRAME_RATE_HZ, MOST_FRAME_RATE_HZ = 10.0, 240.0
MOST_CELLS = 2000
MOST_SECONDS = 1e9
MOST_FRAMES = 4096
"""In one request; the chunks of a live performance have a tenth of a second to a second."""


class CoverageStreamCreate(Request):
    """A new stream: what frames will come, and which speeds and turn rates are wanted."""

    frame_rate_hz: float = Field(
        ge=LEAST_FRAME_RATE_HZ, le=MOST_FRAME_RATE_HZ, allow_inf_nan=False, description="Of the frames that will come."
    )
    skeleton: ItemId | None = Field(None, description="Whose poses will come; roots need none.")
    evaluation: ItemId | None = Field(None, description="Begin with what it found covered, on its grid.")
    speeds_m_s: tuple[Speed, ...] | None = Field(
        None, min_length=1, max_length=200, description="Absent: the evaluation's, or 1 to 3 m/s."
    )
    turn_rates_deg_s: tuple[TurnRate, ...] | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Positive to the left. Absent: the evaluation's, or -100 to 100.",
    )
    least_s: float | None = Field(
        None, gt=0, le=3600, allow_inf_nan=False, description="Wanted in each cell. Absent: the evaluation's, or 1."
    )
    target_count: int = Field(3, ge=0, le=16, description="How many targets are answered.")
    path_s: float = Field(4.0, ge=0.5, le=20, allow_inf_nan=False, description="Length of a target's path in time.")

    @model_validator(mode="after")
    def _check_grid(self) -> Self:
        for name in ("speeds_m_s", "turn_rates_deg_s", "least_s"):
            if self.evaluation is not None and getattr(self, name) is not None:
                raise ValueError(f"{name}: the evaluation says it; leave one of them out")
        for name in ("speeds_m_s", "turn_rates_deg_s"):
            values = getattr(self, name) or ()
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: the same value stands twice")
        if self.speeds_m_s and self.turn_rates_deg_s:
            cells = len(self.speeds_m_s) * len(self.turn_rates_deg_s)
            if cells > MOST_CELLS:
                raise ValueError(f"these speeds and turn rates make {cells} cells, over {MOST_CELLS}")
        return self


class CoverageFrames(Request):
    """The next frames of a performance, of type <f4 or <f8."""

    offset: int = Field(ge=0, le=2**53, description="Frames sent before these.")
    poses: Annotated[NDArray[Any], ArrayOf(ndim=2)] | None = Field(
        None, description="[frames, 3 + 4*joints]: root translation (m), then local quaternions w,x,y,z."
    )
    translations: Annotated[NDArray[Any], ArrayOf(ndim=3, columns=3)] | None = Field(
        None, description="[frames, k, 3]: local translations (m) that replace offsets, with poses."
    )
    translated_joints: tuple[JointName, ...] = Field((), max_length=MAX_JOINTS, description="The k joints they move.")
    roots: Annotated[NDArray[Any], ArrayOf(ndim=2, columns=3)] | None = Field(
        None,
        description="[frames, 3]: x and z of the torso on the ground (m), heading of the body (rad), not smoothed.",
    )
    ends_take: bool = Field(False, description="The performer pauses, or frames were lost, after these.")

    @model_validator(mode="after")
    def _check_frames(self) -> Self:
        if self.poses is not None and self.roots is not None:
            raise ValueError("send poses or roots, not both")
        if self.poses is None and (self.translations is not None or self.translated_joints):
            raise ValueError("translations come with poses")
        for name in ("poses", "translations", "roots"):
            frames = getattr(self, name)
            if frames is not None and not np.issubdtype(frames.dtype, np.floating):
                raise ValueError(f"{name}: dtype {frames.dtype.str}, where <f4 or <f8 is needed")
        if self.frame_count > MOST_FRAMES:
            raise ValueError(f"{self.frame_count} frames; at most {MOST_FRAMES} are taken at once")
        if self.frame_count == 0 and not self.ends_take:
            raise ValueError("no frames, and no end of a take")
        return self

    @property
    def frame_count(self) -> int:
        """Number of these frames."""
        return sum(len(frames) for frames in (self.poses, self.roots) if frames is not None)


class CoverageCell(Answer):
    """A speed and turn rate, and how much there is of it."""

    speed_m_s: float
    turn_rate_deg_s: float = Field(description="Positive to the left.")
    seconds: float
    deficit_s: float = Field(description="What it lacks of the wanted seconds.")


class CoverageTarget(CoverageCell):
    """A cell that lacks data, and the path to walk to fill it."""

    path: tuple[tuple[float, float, float], ...] = Field(
        description="Where to be, each `path_step_s` from the last: metres to the left and ahead, and radians to the "
        "left, of where the performer is and faces."
    )
    path_step_s: float


class Performer(Answer):
    """Position of the performer in the newest frame, and motion in the newest second that is measured."""

    x_m: float
    z_m: float
    heading_rad: float
    speed_m_s: float | None = Field(description="Null until the take has a second.")
    turn_rate_deg_s: float | None
    forward_m_s: float | None
    strafe_m_s: float | None = Field(description="Positive to the left.")


class CoverageNow(Answer):
    """Coverage so far, targets to record next, and the performer, who is null between takes."""

    index: float = Field(description="Share of the cells with enough.")
    missing_s: float = Field(description="What all cells lack together.")
    targets: tuple[CoverageTarget, ...] = Field(description="Nearest to how the performer moves first.")
    performer: Performer | None


class CoverageProgress(CoverageNow):
    """Changes made by the frames of a request."""

    offset: int = Field(description="Frames received so far.")
    windows: int = Field(description="Windows of a second that these frames completed, in whatever cell.")
    changed: tuple[CoverageCell, ...] = Field(description="The cells that have more now.")


class CoverageStream(Answer):
    """A stream of frames whose coverage is measured."""

    id: str
    frame_rate_hz: float
    skeleton: RevisionRef | None
    evaluation: RevisionRef | None
    speeds_m_s: tuple[float, ...] = Field(description="In ascending order.")
    turn_rates_deg_s: tuple[float, ...] = Field(description="In ascending order.")
    least_s: float
    target_count: int
    path_s: float
    offset: int = Field(description="Frames received so far; the next ones start here.")
    created_at: datetime
    updated_at: datetime
    expires_at: datetime = Field(description="When it is dropped if no frames come.")
    rev: int


class CoverageStreamState(CoverageStream, CoverageNow):
    """A stream with its map."""

    seconds: tuple[tuple[float, ...], ...] = Field(description="[speeds, turn rates]: seconds in each cell.")
    deficit_s: tuple[tuple[float, ...], ...] = Field(description="[speeds, turn rates]: what each cell lacks.")
    delay_s: float = Field(description="How long a frame waits until it is part of a window.")


# --- what a stream takes of an evaluation's document -----------------------------------------------------------------


class MeasuredOptions(Answer):
    """The options of an evaluation that its coverage depends on."""

    grid: Grid
    coverage_least_s: float = Field(gt=0, le=3600)


class MeasuredCells(Answer):
    """The map of an evaluation."""

    seconds: Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=2)]

    @model_validator(mode="after")
    def _check_seconds(self) -> Self:
        if not np.all((self.seconds >= 0.0) & (self.seconds <= MOST_SECONDS)):
            raise ValueError(f"seconds: a cell holds 0 to {MOST_SECONDS:g} s")
        return self


class MeasuredCoverage(Answer):
    """The part of `EvaluationDocument` that tells what is covered."""

    options: MeasuredOptions
    coverage: MeasuredCells
