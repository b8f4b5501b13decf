"""Coverage streams: frames sent during a recording, and answers with the motions that are still missing.

Ground positions are in metres. Headings are in radians about +Y: 0 faces +z, and a left turn increases the heading.
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
from marey_schemas.options.evaluation import (
    COVERAGE_LEAST_S,
    LEAST_FRAME_RATE_HZ,
    MOST_CELLS,
    MOST_FRAME_RATE_HZ,
    TARGET_PATH_S,
    Grid,
    Speed,
    TurnRate,
)

MOST_SECONDS = 1e9
MOST_FRAMES = 4096
"""Greatest number of frames in a request; a live performance sends 0.1 s to 1 s at a time."""


MOST_STREAMS = 64
"""Greatest number of streams of a project."""
_GRID = Grid()


def _spanned(values: tuple[float, ...]) -> str:
    return f"{values[0]:g} to {values[-1]:g}"


class CoverageStreamCreate(Request):
    """Request to create a stream: the frame rate and skeleton of its frames, and the speeds and turn rates to cover."""

    frame_rate_hz: float = Field(
        ge=LEAST_FRAME_RATE_HZ,
        le=MOST_FRAME_RATE_HZ,
        allow_inf_nan=False,
        description="Frame rate of the frames that will be sent, in hertz.",
    )
    skeleton: ItemId | None = Field(
        None, description="Skeleton of the poses that will be sent; not needed if only `roots` are sent."
    )
    evaluation: ItemId | None = Field(
        None,
        description="Evaluation from which the stream takes its grid and its initial coverage. Absent: the "
        "coverage is empty at first.",
    )
    speeds_m_s: tuple[Speed, ...] | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Speeds of the grid, in metres per second. Absent: those of the evaluation, or "
        f"{_spanned(_GRID.speeds_m_s)} m/s.",
    )
    turn_rates_deg_s: tuple[TurnRate, ...] | None = Field(
        None,
        min_length=1,
        max_length=200,
        description="Turn rates of the grid, in degrees per second, positive to the left. Absent: those of "
        f"the evaluation, or {_spanned(_GRID.turn_rates_deg_s)}.",
    )
    least_s: float | None = Field(
        None,
        gt=0,
        le=3600,
        allow_inf_nan=False,
        description="Seconds of data that each cell (a speed and a turn rate) needs to count as covered. Absent: "
        f"those of the evaluation, or {COVERAGE_LEAST_S:g}.",
    )
    target_count: int = Field(3, ge=0, le=16, description="Number of targets (motions to record next) in each answer.")
    path_s: float = Field(
        TARGET_PATH_S,
        ge=0.5,
        le=20,
        allow_inf_nan=False,
        description="Duration in seconds of the path that a target asks the performer to walk.",
    )

    @model_validator(mode="after")
    def _check_grid(self) -> Self:
        for name in ("speeds_m_s", "turn_rates_deg_s", "least_s"):
            if self.evaluation is not None and getattr(self, name) is not None:
                raise ValueError(
                    f"{name}: this value comes from the evaluation; give either the evaluation or {name}, not both"
                )
        for name in ("speeds_m_s", "turn_rates_deg_s"):
            values = getattr(self, name) or ()
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: the list contains a value twice; remove one")
        if self.speeds_m_s and self.turn_rates_deg_s:
            cells = len(self.speeds_m_s) * len(self.turn_rates_deg_s)
            if cells > MOST_CELLS:
                raise ValueError(
                    f"speeds_m_s and turn_rates_deg_s make a grid of {cells} cells; at most {MOST_CELLS} are "
                    "allowed, so leave out some values"
                )
        return self


class CoverageFrames(Request):
    """Next frames of a performance, as arrays of dtype <f4 or <f8."""

    offset: int = Field(
        ge=0, le=2**53, description="Number of frames that were sent before the frames of this request."
    )
    poses: Annotated[NDArray[Any], ArrayOf(ndim=2)] | None = Field(
        None,
        description="[frames, 3 + 4*joints]: root translation (m), then local quaternions w,x,y,z; an "
        "alternative to `roots`.",
    )
    translations: Annotated[NDArray[Any], ArrayOf(ndim=3, columns=3)] | None = Field(
        None, description="[frames, k, 3]: local translations (m) that replace the joints' offsets; only with poses."
    )
    translated_joints: tuple[JointName, ...] = Field(
        (), max_length=MAX_JOINTS, description="The k joints that `translations` moves."
    )
    roots: Annotated[NDArray[Any], ArrayOf(ndim=2, columns=3)] | None = Field(
        None,
        description="[frames, 3]: x and z of the torso on the ground (m), heading of the body (rad), not "
        "smoothed; an alternative to `poses`.",
    )
    ends_take: bool = Field(
        False,
        description="Whether the take ends after these frames, because the performer pauses, or because "
        "frames were lost.",
    )

    @model_validator(mode="after")
    def _check_frames(self) -> Self:
        if self.poses is not None and self.roots is not None:
            raise ValueError("send poses or roots, not both")
        if self.poses is None and (self.translations is not None or self.translated_joints):
            raise ValueError("translations can only be sent with poses")
        for name in ("poses", "translations", "roots"):
            frames = getattr(self, name)
            if frames is not None and not np.issubdtype(frames.dtype, np.floating):
                raise ValueError(f"{name}: the dtype is {frames.dtype.str}, but must be <f4 or <f8")
        if self.frame_count > MOST_FRAMES:
            raise ValueError(f"the request has {self.frame_count} frames; at most {MOST_FRAMES} are allowed")
        if self.frame_count == 0 and not self.ends_take:
            raise ValueError("the request has no frames and does not end the take; send frames, or set ends_take")
        return self

    @property
    def frame_count(self) -> int:
        """The number of frames in the request."""
        return sum(len(frames) for frames in (self.poses, self.roots) if frames is not None)


class CoverageCell(Answer):
    """A cell of the grid, one speed and one turn rate, with the seconds of data in it."""

    speed_m_s: float
    turn_rate_deg_s: float = Field(description="Turn rate in degrees per second, positive to the left.")
    seconds: float
    deficit_s: float = Field(description="Seconds of data that the cell still needs.")


class CoverageTarget(CoverageCell):
    """A cell that lacks data, and the path that the performer should walk to record this data."""

    path: tuple[tuple[float, float, float], ...] = Field(
        description="Points of the path, `path_step_s` apart, relative to the performer's place and heading: "
        "metres to the left, metres ahead, and radians to the left."
    )
    path_step_s: float


class Performer(Answer):
    """Position of the performer in the newest frame, and mean velocity in the newest second that was measured."""

    x_m: float
    z_m: float
    heading_rad: float
    speed_m_s: float | None = Field(description="Speed in metres per second; null during the first second of a take.")
    turn_rate_deg_s: float | None
    forward_m_s: float | None
    strafe_m_s: float | None = Field(
        description="Speed sideways, in metres per second, positive to the left; "
        "null during the first second of a take."
    )


class CoverageNow(Answer):
    """Coverage so far, targets to record next, and the state of the performer, which is null between takes."""

    index: float = Field(description="Share of the cells that have enough data.")
    missing_s: float = Field(description="Seconds of data that all cells together still need.")
    targets: tuple[CoverageTarget, ...] = Field(
        description="Cells to record next. The cells closest to the performer's present motion are first."
    )
    performer: Performer | None


class CoverageProgress(CoverageNow):
    """Coverage after the frames of a request, and the changes of the coverage by these frames."""

    offset: int = Field(description="Number of frames received so far.")
    windows: int = Field(
        description="Number of one-second windows that these frames completed, regardless of their cells."
    )
    changed: tuple[CoverageCell, ...] = Field(description="Cells whose data increased.")


class CoverageStream(Answer):
    """A stream of frames whose coverage is measured."""

    id: str
    frame_rate_hz: float
    skeleton: RevisionRef | None
    evaluation: RevisionRef | None
    speeds_m_s: tuple[float, ...] = Field(description="Speeds of the grid in metres per second, in ascending order.")
    turn_rates_deg_s: tuple[float, ...] = Field(
        description="Turn rates of the grid in degrees per second, positive to the left, in ascending order."
    )
    least_s: float
    target_count: int
    path_s: float
    offset: int = Field(description="Number of frames received so far, which is the offset of the next frames.")
    created_at: datetime
    updated_at: datetime
    expires_at: datetime = Field(description="Time at which the stream is deleted if no frames arrive.")
    rev: int


class CoverageStreamState(CoverageStream, CoverageNow):
    """A stream with the coverage of each cell."""

    seconds: tuple[tuple[float, ...], ...] = Field(description="[speeds, turn rates]: seconds of data in each cell.")
    deficit_s: tuple[tuple[float, ...], ...] = Field(
        description="[speeds, turn rates]: seconds of data that each cell still needs."
    )
    delay_s: float = Field(description="Delay of the newest measured window behind the newest frame, in seconds.")


# --- what a stream takes of an evaluation's document -----------------------------------------------------------------


class MeasuredOptions(Answer):
    """Options of an evaluation that determine its coverage; all other options are left out."""

    grid: Grid
    coverage_least_s: float = Field(gt=0, le=3600)


class MeasuredCells(Answer):
    """The coverage of each cell (a speed and a turn rate) in an evaluation."""

    seconds: Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=2)]

    @model_validator(mode="after")
    def _check_seconds(self) -> Self:
        if not np.all((self.seconds >= 0.0) & (self.seconds <= MOST_SECONDS)):
            raise ValueError(f"seconds: the value of each cell must be 0 to {MOST_SECONDS:g} s")
        return self


class MeasuredCoverage(Answer):
    """The members of an `EvaluationDocument` from which a coverage stream takes its grid and its initial coverage."""

    options: MeasuredOptions
    coverage: MeasuredCells
