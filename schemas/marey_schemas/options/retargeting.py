"""Options of retargeting that move hands and feet of a result by inverse kinematics."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Options

HandsFrom = Literal["shoulders", "world"]


class RetargetOptions(Options):
    """Features of the source motion that are kept in addition to its poses."""

    keep_feet: bool = Field(
        False,
        description="Keep feet in place while they touch the floor in the source, with their soles on the floor.",
    )
    keep_hands: bool = Field(
        False,
        description="Keep the positions of the hands, scaled, so that hands that meet in the source meet again.",
    )
    hands_from: HandsFrom = Field(
        "shoulders",
        description="Centre and factor by which keep_hands scales the positions of the hands. shoulders: from the "
        "middle of the shoulders, by the ratio of the arm lengths or less, so that all positions are within "
        "reach; world: from the origin, by the scale of the root's path, for hands on objects or on the floor. "
        "An arm that is too short to reach is straightened towards the position.",
    )

    @model_validator(mode="after")
    def _scales_what_it_keeps(self) -> Self:
        if self.hands_from != "shoulders" and not self.keep_hands:
            raise ValueError("hands_from has no effect without keep_hands; add keep_hands, or leave out hands_from")
        return self
