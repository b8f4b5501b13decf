"""Searches for motions of models that meet constraints: requests and answers."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.options.searching import (
    CANDIDATES,
    CONSTRAINT_WEIGHT,
    LOOK_AXIS,
    PASSES,
    TOLERANCE_DEG,
    TOLERANCE_M,
    TOLERANCE_S,
    TRANSITION_TOLERANCE_M,
    RefineOptions,
)

MOST_CONSTRAINTS = 64
MOST_STEPS = 16
MOST_CANDIDATES = 256
MOST_CANDIDATE_CONSTRAINTS = 4096
"""Greatest product of the numbers of candidates and constraints, which takes some seconds of one thread."""


Moment = Annotated[str, StringConstraints(min_length=1, max_length=255)] | Annotated[float, Field(allow_inf_nan=False)]
"""Label of a keyframe, `start`, `end`, or a canonical frame."""

JointLabel = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Component = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
"""Tolerance; its minimum is below the accuracy of any motion capture, and squared errors divided by it stay finite."""
Distance = Annotated[float, Field(ge=1e-5, le=1e4, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]
ItemId = Annotated[str, StringConstraints(min_length=1, max_length=64)]


def _in_centimetres(name: str) -> Any:
    """Declare the field of release 0.1 that gives in centimetres the value that `name` gives in metres."""
    return Field(
        None,
        exclude=True,
        json_schema_extra={"deprecated": True},
        description=f"Deprecated: `{name}` in centimetres, as release 0.1 spelt it.",
    )


def _read_old_unit(model: Request, name: str, old: str) -> None:
    """Convert a value in centimetres to the field in metres. Raises `ValueError` if both are given."""
    centimetres = getattr(model, old)
    if centimetres is None:
        return
    if name in model.model_fields_set:
        raise ValueError(f"{old}: give only {name}")
    object.__setattr__(model, name, centimetres * 0.01)
    object.__setattr__(model, old, None)
    model.model_fields_set.discard(old)
    model.model_fields_set.add(name)


# --- constraints -----------------------------------------------------------------------------------------------------


class _SearchConstraint(Request):
    at: Moment = Field(
        description="Time of the constraint: the label of a keyframe of the model, start, end, or a canonical frame."
    )
    weight: Positive = Field(CONSTRAINT_WEIGHT, description="Weight of the constraint.")


class _PlaceConstraint(_SearchConstraint):
    tolerance_m: Distance = Field(TOLERANCE_M, description="Distance in metres at which the weighted error is 1.")
    tolerance_cm: Tolerance | None = _in_centimetres("tolerance_m")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        _read_old_unit(self, "tolerance_m", "tolerance_cm")
        return self


class JointPositionConstraint(_PlaceConstraint):
    """Constraint that a joint is at a position."""

    type: Literal["joint_position"]
    joint: JointLabel = Field(description="Name of the joint, its own or its standard name.")
    target_m: tuple[Coordinate | None, Coordinate | None, Coordinate | None] = Field(
        description="Target position (x, y, z) in the world, in metres; null for free coordinates."
    )


class JointOrientationConstraint(_SearchConstraint):
    """Constraint that a joint has a rotation in the world."""

    type: Literal["joint_orientation"]
    joint: JointLabel = Field(description="Name of the joint, its own or its standard name.")
    rotation: tuple[Component, Component, Component, Component] = Field(
        description="Target rotation in the world, as a quaternion (w, x, y, z)."
    )
    tolerance_deg: Tolerance = Field(TOLERANCE_DEG, description="Angle in degrees at which the weighted error is 1.")


class LookDirectionConstraint(_SearchConstraint):
    """Constraint that an axis of a joint points in a direction, or at a point."""

    type: Literal["look_direction"]
    joint: JointLabel = Field(description="Name of the joint, its own or its standard name.")
    direction: tuple[Component, Component, Component] | None = Field(
        None, description="Target direction (x, y, z) in the world."
    )
    point_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="Target point (x, y, z) in the world, in metres, instead of a direction."
    )
    axis: tuple[Component, Component, Component] = Field(
        LOOK_AXIS, description="Axis that shall point there, in the joint's own frame."
    )
    tolerance_deg: Tolerance = Field(TOLERANCE_DEG, description="Angle in degrees at which the weighted error is 1.")


class RootPositionConstraint(_PlaceConstraint):
    """Constraint that the body is at a position on the ground."""

    type: Literal["root_position"]
    target_m: tuple[Coordinate | None, Coordinate | None] = Field(
        description="Target position (x, z) on the ground, in metres; null for free coordinates."
    )


class RootHeadingConstraint(_SearchConstraint):
    """Constraint that the body faces a heading on the ground."""

    type: Literal["root_heading"]
    heading_deg: Degrees = Field(description="Target heading in degrees: 0 along +z, positive to the left.")
    tolerance_deg: Tolerance = Field(TOLERANCE_DEG, description="Angle in degrees at which the weighted error is 1.")


class KeyframeTimeConstraint(_SearchConstraint):
    """Constraint that a keyframe is reached at a time after the beginning of the motion."""

    type: Literal["keyframe_time"]
    seconds: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
    tolerance_s: Tolerance = Field(TOLERANCE_S, description="Deviation in seconds at which the weighted error is 1.")


SearchConstraint = Annotated[
    JointPositionConstraint
    | JointOrientationConstraint
    | LookDirectionConstraint
    | RootPositionConstraint
    | RootHeadingConstraint
    | KeyframeTimeConstraint,
    Field(discriminator="type"),
]
SearchConstraints = Annotated[tuple[SearchConstraint, ...], Field(max_length=MOST_CONSTRAINTS)]


# --- questions and answers -------------------------------------------------------------------------------------------


class StartPlacement(Request):
    """Start of a motion: the model's canonical frame in the world."""

    x: Coordinate = Field(0.0, description="Position along x, in metres.")
    z: Coordinate = Field(0.0, description="Position along z, in metres.")
    heading_deg: Degrees = Field(0.0, description="Heading in degrees: 0 along +z, positive to the left.")


class SearchStep(Request):
    """Motion in a sequence, with its constraints."""

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
        (), max_length=MOST_STEPS, description="Several motions; each begins where the one before it ends."
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
        description="Number of passes; 1: only the tree's samples; each further pass searches near the best "
        "samples so far.",
    )
    refine: bool = Field(True, description="Improve the result of the tree by numerical optimisation.")
    transition_tolerance_m: Distance = Field(
        TRANSITION_TOLERANCE_M,
        description="Discontinuity of hands, feet and height between two steps at which the weighted error "
        "is 1, in metres.",
    )
    transition_tolerance_cm: Tolerance | None = _in_centimetres("transition_tolerance_m")
    finish: bool = Field(False, description="Remove the remaining errors of joint positions by inverse kinematics.")
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of the samples that are drawn if the model has no tree.")
    motion: bool = Field(True, description="Include the motion in the answer.")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        _read_old_unit(self, "transition_tolerance_m", "transition_tolerance_cm")
        return self

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        if self.steps and self.constraints:
            raise ValueError("constraints: for several motions, give them in steps")
        total = sum(len(step.constraints) for step in self.asked_steps)
        if total > MOST_CONSTRAINTS:
            raise ValueError(f"steps: {total} constraints in all; at most {MOST_CONSTRAINTS} are possible")
        if total * self.candidates > MOST_CANDIDATE_CONSTRAINTS:
            most = MOST_CANDIDATE_CONSTRAINTS // total
            raise ValueError(f"candidates: at most {most} are possible with {total} constraints")
        return self

    @property
    def asked_steps(self) -> tuple[SearchStep, ...]:
        """The steps of the request; a single one if only `constraints` are given."""
        return self.steps or (SearchStep(constraints=self.constraints),)


class ConstraintError(Answer):
    """Error of a constraint, in the unit at the end of its name."""

    step: int = Field(description="Index of the step, from 0.")
    constraint: int = Field(description="Index of the constraint within its step, from 0.")
    type: str
    joint: str | None = None
    error_cm: float | None = None
    error_deg: float | None = None
    error_s: float | None = None
    searched_error: float = Field(description="Error after the search of the tree, in the same unit.")
    finished_error: float | None = Field(None, description="Error after inverse kinematics, in the same unit.")
    reached: bool = Field(description="Whether the final error is within the tolerance.")


class FoundStep(Answer):
    """Motion found for a step."""

    model: RevisionRef
    tree: Literal["stored", "drawn"] = Field(
        description="Origin of the samples; drawn: the model has no tree, or an outdated one."
    )
    latent: tuple[float, ...]
    log_likelihood: float
    likelihood_percentile: float | None = Field(
        None,
        description="Percentage of the training examples that are less likely; null if their likelihoods are unknown.",
    )
    duration_s: float
    placement: StartPlacement
    jumps_cm: dict[str, float] = Field(
        default_factory=dict,
        description="Discontinuity of the joints and of the root between the step before and this one.",
    )
    evaluations: int = Field(description="Number of motions that the search of the tree evaluated.")


class SearchAnswer(Answer):
    """Result of a search."""

    steps: tuple[FoundStep, ...]
    errors: tuple[ConstraintError, ...]
    reached: bool = Field(description="Whether all constraints are met.")
    out_of_reach: tuple[int, ...] = Field(
        (), description="Indices of the entries of `errors` that are above 5 cm before inverse kinematics."
    )
    iterations: int = Field(description="Number of iterations of the optimisation.")
    motion: MotionDocument | None = None
