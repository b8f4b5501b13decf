"""Evaluations of locomotion clips: what can be asked for, and the documents of an item of the kind `evaluation`.

The options are those of `marey_motion.evaluation`.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.names import ItemName, Tag

MOST_TRIALS = 2000
MOST_SIMULATED_S = 100_000.0
"""All trials together; the default suite simulates 5,346 s."""

TRIALS_PER_TASK = 8
MOST_EVALUATION_TASKS = 64

Speed = Annotated[float, Field(gt=0, le=20, allow_inf_nan=False)]
TurnRate = Annotated[float, Field(ge=-720, le=720, allow_inf_nan=False)]
Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False, description="Weight of these features.")]
ItemId = Annotated[str, StringConstraints(min_length=1, max_length=64)]
TrialName = Annotated[str, StringConstraints(min_length=1, max_length=100)]

DEFAULT_SPEEDS_M_S = tuple(1.0 + 0.25 * step for step in range(9))
DEFAULT_TURN_RATES_DEG_S = tuple(-100.0 + 25.0 * step for step in range(9))


class FeatureWeightParams(Request):
    """How much each group of features counts in the cost of a match."""

    left_foot_position: Weight = 0.75
    right_foot_position: Weight = 0.75
    left_foot_velocity: Weight = 1.0
    right_foot_velocity: Weight = 1.0
    hip_velocity: Weight = 1.0
    trajectory_positions: Weight = 1.0
    trajectory_directions: Weight = 1.5


class DatabaseParams(Request):
    """How clips become a database for motion matching."""

    mirroring: Literal["none", "add", "only"] = Field(
        "none", description="add: a mirrored twin of every clip beside it; only: the twins alone."
    )
    end_policy: Literal["clamp", "trim", "loop"] = Field(
        "clamp", description="What rows near a clip's end look ahead to: its last frame, nothing, or its beginning."
    )
    root_mode: Literal["simulated", "bone"] = Field(
        "simulated", description="bone: the root joint moves as the character does, in data made so."
    )
    weights: FeatureWeightParams = FeatureWeightParams()
    horizons_s: tuple[Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)], ...] = Field(
        (1 / 3, 2 / 3, 1.0), min_length=1, max_length=8, description="How far ahead the trajectory is looked at."
    )
    extra_joints: tuple[Annotated[str, StringConstraints(min_length=1, max_length=64)], ...] = Field(
        (), max_length=16, description="Standard joints matched beside feet and hips; many drown the trajectory."
    )
    keep_rest_poses: bool = Field(False, description="Keep frames that look like calibration or a T-pose.")


class ControllerParams(Request):
    """How motion matching plays the database."""

    follow: Literal["time", "path", "open_loop"] = Field(
        "time",
        description="What is asked for: the trajectory at the same time, from its nearest point, or only its speed and "
        "turn rate.",
    )
    search_every_s: float = Field(0.1, gt=0, le=2, allow_inf_nan=False, description="Period of the search.")
    continuing_bias: float = Field(
        0.0, ge=-1000, le=1000, allow_inf_nan=False, description="Added to the cost of going on; negative favours it."
    )
    switch_margin: float = Field(
        1e-4, ge=0, le=1000, allow_inf_nan=False, description="A switch must be cheaper by more than this."
    )
    reselect_window_s: float = Field(
        0.0, ge=0, le=10, allow_inf_nan=False, description="Frames so near the current one are not chosen."
    )
    half_life_s: float = Field(0.1, gt=0, le=5, allow_inf_nan=False, description="Of what is blended at a switch.")
    root_inertialisation: bool = Field(True, description="Blend the root's velocity, too.")
    selection: Literal["features", "pose_distance"] = Field(
        "features", description="pose_distance: the published cost, the summed distance of joints in metres."
    )
    root_adjustment: float = Field(
        0.0, ge=0, le=1, allow_inf_nan=False, description="Pulls towards the reference; hides what is measured."
    )
    root_clamp_m: float | None = Field(
        None, gt=0, le=100, allow_inf_nan=False, description="Holds the character so near; hides what is measured."
    )


class EvaluateParams(Request):
    """Parameters of `evaluate`."""

    name: ItemName = Field("evaluation", description="Name of the result.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the result.")
    speeds_m_s: tuple[Speed, ...] = Field(
        DEFAULT_SPEEDS_M_S, min_length=1, max_length=200, description="Speeds of the trials, each with each turn rate."
    )
    turn_rates_deg_s: tuple[TurnRate, ...] = Field(
        DEFAULT_TURN_RATES_DEG_S, min_length=1, max_length=200, description="Turn rates, positive to the left."
    )
    families: tuple[Literal["circle", "switching"], ...] = Field(
        ("circle", "switching"), min_length=1, max_length=2, description="switching: the speed changes on the circle."
    )
    approach_s: float = Field(3.0, ge=0, le=60, allow_inf_nan=False, description="Straight ahead before the circle.")
    duration_s: float = Field(30.0, ge=1, le=600, allow_inf_nan=False, description="Of the circle.")
    switch_speed_m_s: Speed = Field(4.0, description="The other speed of switching trials.")
    switch_every_s: float = Field(5.0, ge=0.5, le=600, allow_inf_nan=False, description="How long each speed lasts.")
    window: Literal["circle", "all"] = Field("circle", description="all: the approach is measured, too.")
    coverage_least_s: float = Field(
        1.0, gt=0, le=3600, allow_inf_nan=False, description="Seconds of data that a cell needs to count as covered."
    )
    literal_formulas: bool = Field(False, description="Add what the published formulas say to the letter.")
    database: DatabaseParams = DatabaseParams()
    controller: ControllerParams = ControllerParams()
    loops: tuple[ItemId, ...] = Field(
        (), max_length=100_000, description="Clips that are loops, besides those whose info has the tag `loop`."
    )
    trims: dict[ItemId, tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(gt=0)]]] = Field(
        default_factory=dict, max_length=100_000, description="Half-open range of frames to use, by clip."
    )
    baseline: bool = Field(True, description="Measure generated clips that own every cell, too, for comparison.")
    report: bool = Field(True, description="Write the report and its figures.")
    trial_figures: tuple[TrialName, ...] = Field(
        (), max_length=16, description="Trials that get figures of their own, by name, as `circle v=1.25 w=-50`."
    )

    @property
    def trial_count(self) -> int:
        """How many trajectories are followed."""
        return len(self.families) * len(self.speeds_m_s) * len(self.turn_rates_deg_s)

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        for name in ("speeds_m_s", "turn_rates_deg_s", "families"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: the same value stands twice")
        if self.trial_count > MOST_TRIALS:
            raise ValueError(
                f"these speeds, turn rates and families make {self.trial_count} trials, over {MOST_TRIALS}"
            )
        simulated_s = self.trial_count * (self.approach_s + self.duration_s)
        if simulated_s > MOST_SIMULATED_S:
            raise ValueError(
                f"{self.trial_count} trials of this length are {simulated_s:,.0f} s, over {MOST_SIMULATED_S:,.0f}"
            )
        for item, (start, stop) in self.trims.items():
            if stop <= start:
                raise ValueError(f"trims.{item}: the end {stop} must lie after the start {start}")
        return self


def count_evaluation_tasks(params: EvaluateParams) -> int:
    """How many tasks the trials are spread over: a few trials each, so that a lost task loses little."""
    per_task = max(TRIALS_PER_TASK, -(-params.trial_count // MOST_EVALUATION_TASKS))
    return -(-params.trial_count // per_task)


# --- the parts of an evaluation --------------------------------------------------------------------------------------


class EvaluationDocument(Request):
    """Part `evaluation`: options, provenance, metrics of every trial, usage, coverage, baseline.

    Its members are those of `marey_motion.evaluation.result.EvaluationResult`, with arrays as leaves; what is fixed
    here is what lists and summaries show.
    """

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation@1"] = Field("marey/evaluation@1", alias="schema")
    verdict: str = Field(max_length=2000, description="How good the clips are, in a sentence or two.")
    headline: dict[str, float | int | None] = Field(max_length=64, description="The numbers that lists show, by name.")


class EvaluationRecords(Request):
    """Part `records`: every tick of every trial, joined over the trials."""

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation-records@1"] = Field("marey/evaluation-records@1", alias="schema")
