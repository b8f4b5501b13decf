"""Options of evaluations: the trials, the measures, the database and the controller."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Options
from marey_schemas.documents.evaluations import ANGLED_FAMILIES
from marey_schemas.options.matching import FOLLOW_MODES, ControllerOptions, DatabaseOptions
from marey_schemas.options.verdict import VerdictLimits
from marey_schemas.sizes import SEEDS

Family = Literal["circle", "switching", "stopping", "corners", "eights", "strafing", "takes"]
"""Families (kinds) of trials, which differ in the path and the speeds that the character has to follow."""
Speed = Annotated[float, Field(gt=0, le=20, allow_inf_nan=False)]
TurnRate = Annotated[float, Field(ge=-720, le=720, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]

LEAST_FRAME_RATE_HZ, MOST_FRAME_RATE_HZ = 10.0, 240.0
"""Least and greatest frame rate at which coverage is measured during a recording."""
MOST_CELLS = 2000
"""Greatest number of cells of a grid whose coverage is measured during a recording."""
COVERAGE_LEAST_S = 1.0
"""Default number of seconds of data that a cell needs to count as covered."""
TARGET_PATH_S = 4.0
"""Default duration in seconds of the path to record for a cell without enough data."""
SETTLING_S = 1.0
"""Seconds before and after a change of the desired motion in which speed, heading and turn rate are not judged.

The character reacts before a change, too, because it looks one second ahead.
"""


class Grid(Options):
    """Speeds and turn rates of trials, in all combinations.

    The defaults are those of the paper that defines the trials (see docs/explanation/evaluation.md).
    """

    speeds_m_s: tuple[Speed, ...] = Field(
        tuple(1.0 + 0.25 * step for step in range(9)),
        min_length=1,
        max_length=200,
        description="Speeds of the trials in metres per second; each is combined with each turn rate.",
    )
    turn_rates_deg_s: tuple[TurnRate, ...] = Field(
        tuple(-100.0 + 25.0 * step for step in range(9)),
        min_length=1,
        max_length=200,
        description="Turn rates of the trials in degrees per second, positive to the left.",
    )

    @model_validator(mode="after")
    def _check_grid(self) -> Self:
        for name in ("speeds_m_s", "turn_rates_deg_s"):
            _require_different(name, getattr(self, name))
        return self


_IMPOSSIBLE: dict[Family, tuple[str, ...]] = {
    "stopping": ("path",),  # the nearest point of the path stays the same at a stop, so the character would never start
    "corners": ("open_loop",),  # a speed and a turn rate do not describe a corner
    "strafing": ("open_loop",),  # nor a direction that differs from the heading
    "takes": ("path", "open_loop"),  # a real path can contain stops and side steps
}
"""Values of the option `follow` with which the trials of a family are not possible."""


class EvaluationOptions(Grid):
    """Options that, together with the clips, determine the result of an evaluation."""

    families: tuple[Family, ...] = Field(
        ("circle", "switching"),
        min_length=1,
        max_length=7,
        description="Kinds of trials. circle: a circle at constant speed; switching: the speed changes on the circle; "
        "stopping: the character stops and starts again on the circle; corners: straight lines with corners of "
        "`corner_angles_deg` between them; eights: two circles that touch, with the turn rate and its opposite; "
        "strafing: a straight line in a direction of `strafe_angles_deg`, while the character keeps facing ahead; "
        "takes: the paths of clips of the set, each of which is left out of the set in its own trial.",
    )
    most_takes: int = Field(
        20,
        ge=1,
        le=500,
        description="Greatest number of `takes` trials. Their clips are chosen evenly from those that last at "
        "least 4 s and move at least 2 m. Of a long clip, the character follows at most `duration_s` "
        "seconds.",
    )
    corner_angles_deg: tuple[Angle, ...] = Field(
        (-90.0, 90.0, 180.0),
        min_length=1,
        max_length=200,
        description="Angles of the corners of `corners` trials in degrees, positive to the left; each is combined with "
        "each speed.",
    )
    strafe_angles_deg: tuple[Angle, ...] = Field(
        (-90.0, 90.0, 180.0),
        min_length=1,
        max_length=200,
        description="Directions of `strafing` trials in degrees from the facing direction, positive to the left; 180: "
        "backwards. Each is combined with each speed.",
    )
    approach_s: float = Field(
        3.0,
        ge=0,
        le=60,
        allow_inf_nan=False,
        description="Duration of the approach in seconds: the straight path before the circle.",
    )
    duration_s: float = Field(
        30.0, ge=1, le=600, allow_inf_nan=False, description="Duration of the circle in seconds, after the approach."
    )
    switch_speed_m_s: Speed = Field(
        4.0,
        description="Second speed of switching trials, in metres per second; the first is one of `speeds_m_s`.",
    )
    switch_every_s: float = Field(
        5.0,
        ge=0.5,
        le=600,
        allow_inf_nan=False,
        description="Seconds that each speed of a switching trial lasts; also the seconds from a start to the next "
        "stop, and from corner to corner.",
    )
    replicates: int = Field(
        8,
        ge=1,
        le=64,
        description="Number of replicates of each trial. The first one is the trial itself; each further one has "
        "another phase of the stride at the start, and an approach that is up to one second longer. "
        "Results are means with 95 % intervals. 1: only the trial itself, as in Abichequer Sangalli et al. (2022), "
        "without intervals.",
    )
    seed: int = Field(
        0, ge=0, lt=SEEDS, description="Seed of the random differences between the replicates of a trial."
    )
    window: Literal["circle", "all"] = Field(
        "circle",
        description="Part of a trial that is measured. circle: the course after the approach; all: "
        "also the approach (the straight path before it).",
    )
    coverage_least_s: float = Field(
        COVERAGE_LEAST_S,
        gt=0,
        le=3600,
        allow_inf_nan=False,
        description="Seconds of data that a cell of the coverage map (a speed and a turn rate) needs to count as "
        "covered.",
    )
    literal_formulas: bool = Field(
        False,
        description="Also compute errors by the formulas of Abichequer Sangalli et al. (2022) exactly as they are "
        "printed, only to compare results with those of this publication.",
    )
    database: DatabaseOptions = Field(
        DatabaseOptions(), description="Options of the database that is built from the clips."
    )
    controller: ControllerOptions = Field(ControllerOptions(), description="Options of the motion matching controller.")
    limits: VerdictLimits = Field(VerdictLimits(), description="Limits within which a trial counts as followed.")

    @model_validator(mode="after")
    def _check_families(self) -> Self:
        for name in ("families", "corner_angles_deg", "strafe_angles_deg"):
            _require_different(name, getattr(self, name))
        for family in self.families:
            if self.controller.follow in (modes := _IMPOSSIBLE.get(family, ())):
                possible = " or ".join(mode for mode in FOLLOW_MODES if mode not in modes)
                raise ValueError(
                    f"{family} trials cannot be followed in the mode {self.controller.follow}; choose {possible}"
                )
        self._require_changes()
        return self

    def _require_changes(self) -> None:
        """Raise `ValueError` if trials of `corners` or `eights` are too short.

        Their duration must exceed the time until the first change plus the time after it that is not judged.
        """
        periods_s: list[tuple[Family, float, str]] = []
        if "corners" in self.families:
            periods_s.append(("corners", self.switch_every_s, "the first corner comes"))
        if "eights" in self.families and (rates := self.courses_deg("eights")):
            slowest = min(map(abs, rates))
            periods_s.append(("eights", 360.0 / slowest, f"a full circle at {slowest:g} degrees/s ends"))
        for family, every_s, change in periods_s:
            least_s = every_s + settling_s(every_s)
            if self.duration_s <= least_s:
                raise ValueError(
                    f"{family} trials of {self.duration_s:g} s are too short: {change} after {every_s:.4g} s, and the "
                    f"next {settling_s(every_s):.4g} s are not judged; choose a duration above {least_s:.4g} s"
                )

    def courses_deg(self, family: Family) -> tuple[float, ...]:
        """Return the values that trials of a family combine with each speed: turn rates (deg/s) or angles (deg).

        Trials along takes depend on the clips, so they are not listed.
        """
        if family == "takes":
            return ()
        if family in ANGLED_FAMILIES:
            return self.corner_angles_deg if family == "corners" else self.strafe_angles_deg
        return tuple(rate for rate in self.turn_rates_deg_s if rate or family != "eights")


def settling_s(every_s: float) -> float:
    """Return the seconds before and after each change that are not judged, if changes are `every_s` seconds apart.

    Half of the time between two changes is always judged.
    """
    return min(SETTLING_S, 0.25 * every_s)


def _require_different(name: str, values: tuple[object, ...]) -> None:
    if len(set(values)) != len(values):
        raise ValueError(f"{name}: the list contains a value twice; remove one")
