"""Motions of models that meet constraints: what can be asked for, and what was found."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.options.searching import RefineOptions

MOST_CONSTRAINTS = 64
MOST_STEPS = 16
MOST_CANDIDATES = 256
MOST_CANDIDATE_CONSTRAINTS = 4096
"""Candidates times constraints: some seconds of one thread."""


Moment = Annotated[str, StringConstraints(min_length=1, max_length=255)] | Annotated[float, Field(allow_inf_nan=False)]
"""The label of a keyframe, `start`, `end`, or a canonical frame."""

JointLabel = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Component = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
"""No motion was ever captured so exactly, and squares of errors in smaller ones cannot be computed with."""
Distance = Annotated[float, Field(ge=1e-5, le=1e4, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]
ItemId = Annotated[str, StringConstraints(min_length=1, max_length=64)]


def _in_centimetres(name: str) -> Any:
    """Declare the field of release 0.1 that says in centimetres what `name` says in metres."""
    return Field(
        None,
        exclude=True,
        json_schema_extra={"deprecated": True},
        description=f"Deprecated: `{name}` in centimetres, as release 0.1 spelt it.",
    )


def _read_old_unit(model: Request, name: str, old: str) -> None:
    """Move a value in centimetres to the field in metres. Raises `ValueError` where both are given."""
    centimetres = getattr(model, old)
    if centimetres is None:
        return
    if name in model.model_fields_set:
        raise ValueError(f"{old}: give {name} alone")
    object.__setattr__(model, name, centimetres * 0.01)
    object.__setattr__(model, old, None)
    model.model_fields_set.discard(old)
    model.model_fields_set.add(name)


# --- constraints -----------------------------------------------------------------------------------------------------


class _SearchConstraint(Request):
    at: Moment = Field(description="Label of a keyframe of the model, start, end, or a canonical frame.")
    weight: Positive = Field(1.0, description="How much it counts.")


class _PlaceConstraint(_SearchConstraint):
    tolerance_m: Distance = Field(0.01, description="The error that counts as 1, in metres.")
    tolerance_cm: Tolerance | None = _in_centimetres("tolerance_m")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        _read_old_unit(self, "tolerance_m", "tolerance_cm")
        return self


class JointPositionConstraint(_PlaceConstraint):
    """A joint is at a place."""

    type: Literal["joint_position"]
    joint: JointLabel = Field(description="Its own name, or its standard name.")
    target_m: tuple[Coordinate | None, Coordinate | None, Coordinate | None] = Field(
        description="(x, y, z) in the world; null where it is free."
    )


class JointOrientationConstraint(_SearchConstraint):
    """A joint is turned so."""

    type: Literal["joint_orientation"]
    joint: JointLabel = Field(description="Its own name, or its standard name.")
    rotation: tuple[Component, Component, Component, Component] = Field(description="(w, x, y, z) in the world.")
    tolerance_deg: Tolerance = Field(5.0, description="The error that counts as 1, in degrees.")


class LookDirectionConstraint(_SearchConstraint):
    """An axis of a joint points in a direction, or at a point."""

    type: Literal["look_direction"]
    joint: JointLabel = Field(description="Its own name, or its standard name.")
    direction: tuple[Component, Component, Component] | None = Field(None, description="(x, y, z) in the world.")
    point_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(None, description="In place of a direction.")
    axis: tuple[Component, Component, Component] = Field((0.0, 0.0, 1.0), description="In the joint's own frame.")
    tolerance_deg: Tolerance = Field(5.0, description="The error that counts as 1, in degrees.")


class RootPositionConstraint(_PlaceConstraint):
    """The body stands over a place on the ground."""

    type: Literal["root_position"]
    target_m: tuple[Coordinate | None, Coordinate | None] = Field(description="(x, z); null where it is free.")


class RootHeadingConstraint(_SearchConstraint):
    """The body faces a heading on the ground."""

    type: Literal["root_heading"]
    heading_deg: Degrees = Field(description="0 along +z, positive to the left.")
    tolerance_deg: Tolerance = Field(5.0, description="The error that counts as 1, in degrees.")


class KeyframeTimeConstraint(_SearchConstraint):
    """A moment comes so long after the motion's beginning."""

    type: Literal["keyframe_time"]
    seconds: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
    tolerance_s: Tolerance = Field(0.05, description="The error that counts as 1, in seconds.")


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

    x: Coordinate = Field(0.0, description="Metres.")
    z: Coordinate = Field(0.0, description="Metres.")
    heading_deg: Degrees = Field(0.0, description="0 along +z, positive to the left.")


class SearchStep(Request):
    """One motion of several."""

    model: ItemId | None = Field(None, description="A model of the project; absent: that of the address.")
    constraints: SearchConstraints = ()


class SearchRequest(RefineOptions):
    """Ask for a motion, or for several that follow one another, that meet constraints."""

    constraints: SearchConstraints = Field((), description="On one motion.")
    steps: tuple[SearchStep, ...] = Field(
        (), max_length=MOST_STEPS, description="Several motions, each placed where the one before it ends."
    )
    start: StartPlacement = StartPlacement()
    candidates: int = Field(8, ge=1, le=MOST_CANDIDATES, description="Nodes that are followed down the tree.")
    passes: int = Field(
        2, ge=1, le=4, description="1: the tree's samples alone; each further one looks closer around the best so far."
    )
    refine: bool = Field(True, description="Improve what the tree has by numerical optimisation.")
    transition_tolerance_m: Distance = Field(
        0.02, description="Error of hands, feet and height from step to step that counts as 1, in metres."
    )
    transition_tolerance_cm: Tolerance | None = _in_centimetres("transition_tolerance_m")
    finish: bool = Field(False, description="Remove what is left of joint positions by inverse kinematics.")
    seed: int = Field(0, ge=0, lt=2**63, description="Of the samples, where the model has no tree of its own.")
    motion: bool = Field(True, description="Send the motion, too.")

    @model_validator(mode="after")
    def _read_centimetres(self) -> Self:
        _read_old_unit(self, "transition_tolerance_m", "transition_tolerance_cm")
        return self

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        if self.steps and self.constraints:
            raise ValueError("constraints: on several motions they stand in steps")
        total = sum(len(step.constraints) for step in self.asked_steps)
        if total > MOST_CONSTRAINTS:
            raise ValueError(f"steps: {total} constraints in all, over {MOST_CONSTRAINTS}")
        if total * self.candidates > MOST_CANDIDATE_CONSTRAINTS:
            most = MOST_CANDIDATE_CONSTRAINTS // total
            raise ValueError(f"candidates: at most {most} where there are {total} constraints")
        return self

    @property
    def asked_steps(self) -> tuple[SearchStep, ...]:
        """The steps; one where there are constraints alone."""
        return self.steps or (SearchStep(constraints=self.constraints),)


class ConstraintError(Answer):
    """Error of a constraint, in the unit at the end of its name."""

    step: int = Field(description="From 0.")
    constraint: int = Field(description="Within the step, from 0.")
    type: str
    joint: str | None = None
    error_cm: float | None = None
    error_deg: float | None = None
    error_s: float | None = None
    searched_error: float = Field(description="After the search of the tree, in the same unit.")
    finished_error: float | None = Field(None, description="After inverse kinematics, in the same unit.")
    reached: bool = Field(description="Within its tolerance, at the end.")


class FoundStep(Answer):
    """One motion that was found."""

    model: RevisionRef
    tree: Literal["stored", "drawn"] = Field(description="drawn: the model has no tree of its own, or an outdated one.")
    latent: tuple[float, ...]
    log_likelihood: float
    likelihood_percentile: float | None = Field(
        None, description="Percent of the training examples that are less likely; null where those are not known."
    )
    duration_s: float
    placement: StartPlacement
    jumps_cm: dict[str, float] = Field(
        default_factory=dict, description="By which joints jump from the step before this one, and the root."
    )
    evaluations: int = Field(description="Motions that the search of the tree looked at.")


class SearchAnswer(Answer):
    """Result of a search."""

    steps: tuple[FoundStep, ...]
    errors: tuple[ConstraintError, ...]
    reached: bool = Field(description="Whether all constraints are.")
    out_of_reach: tuple[int, ...] = Field(
        (), description="Places in `errors` that are off by more than 5 cm before inverse kinematics."
    )
    iterations: int = Field(description="Of the optimisation.")
    motion: MotionDocument | None = None
