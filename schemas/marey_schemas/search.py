"""Searches in models for motions that meet constraints, and searches by example: requests and answers."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.metrics import MetricIdentity
from marey_schemas.documents.references import RevisionRef
from marey_schemas.names import ItemId
from marey_schemas.old_units import in_centimetres, read_old_unit
from marey_schemas.options.perception import DEFAULT_METRIC
from marey_schemas.options.searching import (
    CANDIDATES,
    PASSES,
    TRANSITION_TOLERANCE_M,
    RefineOptions,
)
from marey_schemas.search_constraints import Coordinate, Degrees, Distance, SearchConstraint, Tolerance
from marey_schemas.sizes import MOST_INTEGER, SEEDS

MOST_CONSTRAINTS = 64
MOST_STEPS = 16
MOST_CANDIDATES = 256
MOST_CANDIDATE_CONSTRAINTS = 4096
"""Greatest product of the number of candidates and the number of constraints; such a search takes a few seconds."""

SearchConstraints = Annotated[tuple[SearchConstraint, ...], Field(max_length=MOST_CONSTRAINTS)]


class StartPlacement(Request):
    """Position and heading, in the world, of a model's coordinate frame, near whose origin the motions start."""

    x: Coordinate = Field(0.0, description="Position along x, in metres.")
    z: Coordinate = Field(0.0, description="Position along z, in metres.")
    heading_deg: Degrees = Field(0.0, description="Heading in degrees: 0 along +z, positive to the left.")


class SearchStep(Request):
    """One motion of a sequence, with the constraints that it must meet."""

    model: ItemId | None = Field(
        None, description="Id of a model of the project; absent: the model in the request's path."
    )
    constraints: SearchConstraints = ()


class SearchRequest(RefineOptions):
    """Request for one motion, or several consecutive motions, that meet constraints."""

    constraints: SearchConstraints = Field(
        (), description="Constraints on a single motion; for several motions, use `steps`."
    )
    steps: tuple[SearchStep, ...] = Field(
        (), max_length=MOST_STEPS, description="Several motions; each begins where the previous motion ends."
    )
    start: StartPlacement = StartPlacement()
    candidates: int = Field(
        CANDIDATES,
        ge=1,
        le=MOST_CANDIDATES,
        description="Number of nodes of the tree that the search follows at each level.",
    )
    passes: int = Field(
        PASSES,
        ge=1,
        le=4,
        description="Number of passes. The first pass searches the samples of the tree; each further pass searches "
        "near the best samples so far.",
    )
    refine: bool = Field(True, description="Improve the result of the tree by numerical optimisation.")
    transition_tolerance_m: Distance = Field(
        TRANSITION_TOLERANCE_M,
        description="Size of a jump between two steps that counts as an error of 1, in metres; jumps of hands, feet "
        "and the height of the pelvis are measured.",
    )
    transition_tolerance_cm: Tolerance | None = in_centimetres("transition_tolerance_m")
    finish: bool = Field(False, description="Remove the remaining errors of joint positions by inverse kinematics.")
    seed: int = Field(0, ge=0, lt=SEEDS, description="Seed of the samples that are drawn if the model has no tree.")
    motion: bool = Field(True, description="Include the motion in the answer.")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        read_old_unit(self, "transition_tolerance_m", "transition_tolerance_cm")
        return self

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        if self.steps and self.constraints:
            raise ValueError(
                "constraints: in a search for several motions, give the constraints of each motion in its step"
            )
        total = sum(len(step.constraints) for step in self.asked_steps)
        if total > MOST_CONSTRAINTS:
            raise ValueError(
                f"steps: the steps have {total} constraints together; at most {MOST_CONSTRAINTS} are allowed"
            )
        if total * self.candidates > MOST_CANDIDATE_CONSTRAINTS:
            most = MOST_CANDIDATE_CONSTRAINTS // total
            raise ValueError(f"candidates: with {total} constraints, at most {most} candidates are allowed")
        return self

    @property
    def asked_steps(self) -> tuple[SearchStep, ...]:
        """The steps of the request; a single step if the request gives only `constraints`."""
        return self.steps or (SearchStep(constraints=self.constraints),)


class ConstraintError(Answer):
    """Error of the motion at a constraint, before inverse kinematics: `error_cm`, `error_deg` or `error_s`."""

    step: int = Field(description="Index of the step, from 0.")
    constraint: int = Field(description="Index of the constraint within its step, from 0.")
    type: str
    joint: str | None = None
    error_cm: float | None = None
    error_deg: float | None = None
    error_s: float | None = None
    searched_error: float | None = Field(
        None,
        description="Error after the search of the tree and before numerical optimisation, in the unit of the "
        "error. Null: the server has an earlier version, which does not report it.",
    )
    finished_error: float | None = Field(
        None, description="Error after inverse kinematics, in the unit of the error; null without inverse kinematics."
    )
    reached: bool = Field(description="Whether the error of the answered motion is within the tolerance.")


class FoundStep(Answer):
    """Motion that a search found for one step of its request, as a model and a latent vector."""

    model: RevisionRef
    tree: Literal["stored", "drawn"] = Field(
        description="Origin of the samples. stored: the tree of the model; drawn: samples were drawn for this search, "
        "because the model has no tree, or an outdated one."
    )
    latent: tuple[float, ...]
    log_likelihood: float
    likelihood_percentile: float | None = Field(
        None,
        description="Percentage of the training examples that are less likely than the motion; null if unknown.",
    )
    duration_s: float
    placement: StartPlacement
    jumps_cm: dict[str, float] = Field(
        default_factory=dict,
        description="Distances, in centimetres, by which the root and joints jump between the previous step and this "
        "one, by joint.",
    )
    evaluations: int = Field(description="Number of motions that the search of the tree evaluated.")


class SearchAnswer(Answer):
    """Result of a search: the motion of each step, and the error of each constraint."""

    steps: tuple[FoundStep, ...]
    errors: tuple[ConstraintError, ...]
    reached: bool = Field(description="Whether all constraints are met.")
    out_of_reach: tuple[int, ...] = Field(
        (), description="Indices in `errors` of the constraints whose error exceeds 5 cm before inverse kinematics."
    )
    iterations: int = Field(description="Number of iterations of the numerical optimisation.")
    motion: MotionDocument | None = None


# -- searches by example -----------------------------------------------------------------------------------------------

MOST_MOMENTS = 100
LONGEST_EXAMPLE_S = 60.0
"""Greatest duration of the example of a search, in seconds."""

FrameNumber = Annotated[int, Field(ge=0, le=MOST_INTEGER)]


class SimilarOptions(Request):
    """Options of a search by example."""

    results: int = Field(10, ge=1, le=MOST_MOMENTS, description="Greatest number of moments to return.")
    mirrored: bool = Field(
        False, description="Also find moments that resemble the example with left and right exchanged."
    )
    leave_out: Literal["window", "clip", "nothing"] = Field(
        "window",
        description="Moments of the example's own clip to leave out: those that overlap the example, all, or none.",
    )
    metric: ItemId = Field(
        DEFAULT_METRIC,
        description="Perceptual metric: the name of a built-in one, such as `published/sigmoid`, or the id of a stored "
        "one.",
    )
    index: ItemId | None = Field(
        None, description="Id of the index to search; absent: the index of the project that was updated last."
    )


class SimilarRequest(SimilarOptions):
    """Request for the moments that resemble an example."""

    clip: ItemId = Field(description="Id of the clip that contains the example.")
    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision of the clip; absent: the newest.")
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
    metric: MetricIdentity | None = Field(
        None,
        description="The metric of the distances. Null: the server has an earlier version, which does not report it.",
    )
