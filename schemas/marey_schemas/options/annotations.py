"""Options of foot contacts, and of proposals of segments and keyframes."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Options, Tagged
from marey_schemas.names import JointName
from marey_schemas.options.contacts import STANCE_SPEED_M_S

Seconds = Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=0, le=360, allow_inf_nan=False)]


OUT_OF_REST = 0.25
"""Share of the farthest distance of a hand from its rest position above which the hand is reaching."""


class ContactOptions(Options):
    """Options for detecting the contacts of a foot with the ground."""

    speed_m_s: float = Field(
        STANCE_SPEED_M_S,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Greatest speed of a foot in contact, in metres per second.",
    )
    shortest_swing_s: float = Field(
        0.1,
        gt=0,
        le=10,
        allow_inf_nan=False,
        description="Least duration of a swing phase, in seconds; shorter ones are treated as noise.",
    )
    shortest_stance_s: float = Field(
        0.06,
        gt=0,
        le=10,
        allow_inf_nan=False,
        description="Least duration of a stance phase, in seconds; shorter ones are treated as noise.",
    )


class _Proposal(Tagged):
    tag: ClassVar[str] = "method"


class StepsProposal(_Proposal):
    """Steps of a walk or run: each lasts from the contact of one foot to the contact of the other foot.

    A step is named after the foot that swings.
    """

    method: Literal["steps"] = Field("steps", description="Name of the method that proposes segments and keyframes.")
    contact_speed_m_s: float = Field(
        STANCE_SPEED_M_S,
        gt=0,
        le=10,
        allow_inf_nan=False,
        description="Speed in metres per second below which a foot is in contact.",
    )
    shortest_s: Seconds = Field(0.2, description="Duration of the shortest step that is labelled, in seconds.")
    longest_s: Seconds = Field(1.5, description="Duration of the longest step that is labelled, in seconds.")
    shortest_m: float = Field(
        0.2, ge=0, le=10, allow_inf_nan=False, description="Least distance that the hips travel in a step, in metres."
    )
    most_turn_deg: Degrees = Field(
        45.0, description="A step is labelled only if the body turns by at most this angle in it, in degrees."
    )
    most_aside_deg: Degrees = Field(
        45.0,
        description="Greatest angle between the direction of a labelled step and the heading of the body, in degrees.",
    )
    standing_s: Seconds = Field(
        0.6, description="Least time with both feet on the ground that is labelled `standing`, in seconds."
    )

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        if self.longest_s <= self.shortest_s:
            raise ValueError("longest_s must be more than shortest_s")
        return self


class VelocityMinimaProposal(_Proposal):
    """Movements from one minimum of the speed of joints to the next, with a keyframe `pause` at each minimum."""

    method: Literal["velocity_minima"] = Field(
        "velocity_minima", description="Name of the method that proposes segments and keyframes."
    )
    joints: tuple[JointName, ...] = Field(
        (), max_length=256, description="Joints whose mean speed is used, by their own or their standard names."
    )
    smoothing_s: float = Field(
        0.05,
        gt=0,
        le=10,
        allow_inf_nan=False,
        description="Standard deviation of the Gaussian that smooths the speed, in seconds.",
    )
    least_depth: float = Field(
        0.1,
        gt=0,
        le=1,
        allow_inf_nan=False,
        description="Least depth of a minimum of the speed, as a share of the highest speed in the clip.",
    )
    least_apart_s: float = Field(
        0.2, gt=0, le=3600, allow_inf_nan=False, description="Least time between two minima, in seconds."
    )


class WristContactProposal(_Proposal):
    """Movements of a hand away from its rest position and back, with a keyframe `contact` when the hand arrives."""

    method: Literal["wrist_contact"] = Field(
        "wrist_contact", description="Name of the method that proposes segments and keyframes."
    )
    hand: Literal["left", "right", "either"] = Field(
        "either", description="Hand whose reaches are found; either: the hand that reaches farther."
    )
    least_reach_m: float = Field(
        0.2,
        gt=0,
        le=10,
        allow_inf_nan=False,
        description="Least distance from the rest position, in metres, that the hand must reach.",
    )
    arrived: float = Field(
        0.95,
        gt=OUT_OF_REST,
        le=1,
        allow_inf_nan=False,
        description="In each reach, share of the farthest distance from the rest position at which the hand has "
        "arrived.",
    )
    release: bool = Field(
        False,
        description="Also add a keyframe `release` at the last frame in which the distance of the hand from rest is "
        "at least the share `arrived` of the farthest distance.",
    )


Proposal = Annotated[StepsProposal | VelocityMinimaProposal | WristContactProposal, Field(discriminator="method")]
