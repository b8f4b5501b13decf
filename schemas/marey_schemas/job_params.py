"""Parameters of the built-in kinds of jobs: the options of what they do, and names and tags of the results."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, field_validator, model_validator

from marey_schemas.base import Request
from marey_schemas.editing.edits import MOST_COMMANDS, EditCommand
from marey_schemas.formats import ExportFormat, WrittenUnit
from marey_schemas.imports import ImportFile
from marey_schemas.names import (
    MAX_NAME_LENGTH,
    ItemId,
    ItemName,
    JointName,
    Label,
    LayerName,
    NameSuffix,
    Tag,
    TrialName,
)
from marey_schemas.options.annotations import Proposal, Seconds
from marey_schemas.options.evaluation import DEFAULT_SPEEDS_M_S, DEFAULT_TURN_RATES_DEG_S, Speed, TurnRate
from marey_schemas.options.imports import ImportOptions
from marey_schemas.options.improvement import ObjectiveParams
from marey_schemas.options.matching import ControllerParams, DatabaseParams, FeatureWeightParams

MOST_EXAMPLES = 2000
"""That are all compared with each other, mirrored ones counted."""
Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
ReferenceChoice = Annotated[str, StringConstraints(min_length=1, max_length=64)]


class AlignParams(Request):
    """Parameters of `align`."""

    suffix: NameSuffix = Field("", description="Appended to the names of the results.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")
    reference: ReferenceChoice = Field(
        "medoid",
        description="Whose time is the canonical time: medoid (the clip nearest to all others), nearest_mean_length, "
        "or the id of a clip.",
    )
    rate_hz: float | None = Field(
        None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Of canonical frames; default: that of the reference where it is named, else the commonest one.",
    )
    layer: LayerName | None = Field(
        None, description="Layer of the annotations to go by; default: the only one that a clip has among the input."
    )
    labels: tuple[Label, ...] = Field(
        (), max_length=1000, description="Labels whose segments and keyframes cut the clips; none: all of them."
    )
    slope_limit: int | None = Field(
        3, ge=0, le=60, description="So many frames in a row of one clip may belong to one of the other; null: any."
    )
    cost: Literal["turned", "plain"] = Field(
        "turned",
        description="turned: poses are compared after the best turn and shift on the ground; plain: as they are.",
    )
    window: int = Field(1, ge=1, le=61, description="Odd number of frames that are compared at once.")
    weights: dict[JointName, Weight] = Field(
        default_factory=dict,
        max_length=4096,
        description="Weight in the cost by joint, under its own or its standard name; others count 1.",
    )
    mirroring: Literal["none", "add"] = Field("none", description="add: a mirrored twin of every clip beside it.")
    keep_height: bool = Field(True, description="Leave heights above the floor as they are.")

    @field_validator("window")
    @classmethod
    def _check_window(cls, window: int) -> int:
        if window % 2 == 0:
            raise ValueError("must be odd: as many frames before as after")
        return window


_NAME_FIELD = re.compile(r"\{(clip|label|number)(?::([1-9]))?\}")


class AnnotateParams(Request):
    """Parameters of `annotate`."""

    proposal: Proposal = Field(description="Method that proposes segments and keyframes, with its options.")
    layer: LayerName | None = Field(None, description="Name of the layer; default: that of the method.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the annotations.")


class CutParams(Request):
    """Parameters of `cut`."""

    layer: LayerName | None = Field(None, description="Only annotations of this layer.")
    labels: tuple[Label, ...] = Field((), max_length=1000, description="Labels to cut out; none: all of them.")
    margin_before_s: Seconds = Field(0.0, description="Time before each segment that is taken along, where there is.")
    margin_after_s: Seconds = Field(0.0, description="Time after each segment that is taken along, where there is.")
    shortest_s: Seconds = Field(0.0, description="Shorter segments are left out.")
    longest_s: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = Field(
        None, description="Longer segments are left out."
    )
    name: str = Field(
        "{clip}_{label}_{number:2}",
        min_length=1,
        max_length=MAX_NAME_LENGTH,
        description="Names of the pieces; {number:2} counts the segments of a label in a clip from 1, in two digits.",
    )
    by_label: bool = Field(False, description="Put the pieces of each label into a folder of its own.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the pieces.")

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        fields = {found.group(1) for found in _NAME_FIELD.finditer(name)}
        if fields != {"clip", "label", "number"}:
            raise ValueError("must have {clip}, {label} and {number} in it, so that no two pieces share a name")
        if set("{}/") & set(_NAME_FIELD.sub("", name)):
            raise ValueError("only {clip}, {label} and {number} (or {number:3} for three digits) may be in braces")
        return name

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        if self.longest_s is not None and self.longest_s < self.shortest_s:
            raise ValueError("longest_s must not be less than shortest_s")
        return self

    def piece_name(self, clip: str, label: str, number: int) -> str:
        """Name of a piece."""
        given = {"clip": clip, "label": label.replace("/", "-")}

        def text(found: re.Match[str]) -> str:
            name, digits = found.groups()
            return given[name] if name in given else str(number).zfill(int(digits or 1))

        return _NAME_FIELD.sub(text, self.name)


MOST_TRIALS = 2000
MOST_SIMULATED_S = 100_000.0
"""All trials together; the default suite simulates 5,346 s."""
TRIALS_PER_TASK = 8
MOST_EVALUATION_TASKS = 64


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


WEIGHT_GROUPS = len(FeatureWeightParams.model_fields)
Factor = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class CompareParams(Request):
    """Parameters of `compare`."""

    title: str = Field("", max_length=200, description="Of the report; default: the names of the two.")
    report: bool = Field(True, description="Write the report, a page of HTML that needs nothing else.")


class SuggestParams(Request):
    """Parameters of `suggest`."""

    objective: ObjectiveParams = ObjectiveParams()
    removals: int = Field(
        10,
        ge=0,
        le=1000,
        description="How many removals to plan after one another, once unused clips are gone; 0: none.",
    )
    consider: int | None = Field(
        50, ge=0, le=100_000, description="Leave out in turn only so many clips, those that fewest trials need."
    )
    duplicate_cm: float = Field(
        3.0, ge=0, le=100, allow_inf_nan=False, description="Clips up to so far apart per frame are near-duplicates."
    )
    blendable_m: float | None = Field(
        None,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Poses up to so far apart, summed over joints, blend; default: the median of the trials' switches.",
    )


class OptimiseParams(Request):
    """Parameters of `optimise`."""

    objective: ObjectiveParams = ObjectiveParams()
    least_gain: float = Field(
        1e-4, ge=0, le=1000, allow_inf_nan=False, description="End when no step lowers the objective by so many metres."
    )
    max_steps: int = Field(50, ge=1, le=10_000, description="End after so many steps.")
    max_evaluations: int | None = Field(
        None, ge=1, le=1_000_000, description="End after so many sets of clips were tried."
    )
    max_data_s: float | None = Field(
        None, gt=0, le=1e7, allow_inf_nan=False, description="Add nothing that makes the set longer, in seconds."
    )
    consider: int | None = Field(
        20, ge=1, le=100_000, description="Try only so many removals and so many additions in each step."
    )


class SweepParams(Request):
    """Parameters of `sweep`."""

    objective: ObjectiveParams = ObjectiveParams()
    factors: tuple[Factor, ...] = Field(
        (0.5, 2.0),
        min_length=1,
        max_length=20,
        description="Each group of features is matched with its weight times each of these, all others as they are.",
    )


def count_sweep_tasks(params: SweepParams) -> int:
    """A task for each setting of the weights."""
    return 1 + WEIGHT_GROUPS * len(params.factors)


Share = Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)]


class ModelParams(Request):
    """Parameters of `model`."""

    name: ItemName = Field("model", description="Name of the result, and of the action.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the result.")
    scaling: Literal["jacobian", "root_max", "sfpca", "none"] = Field(
        "jacobian",
        description="How channels are weighed. jacobian: by how far they move the body; sfpca: optimised for the "
        "positions of joints; root_max: root axes to a maximum of 1; none: as they are.",
    )
    inner_product: Literal["coefficients", "l2"] = Field(
        "coefficients", description="l2: integrals of products of functions, which do not depend on the knots."
    )
    spatial_share: Share = Field(0.95, description="Share of the variance that the spatial components hold.")
    spatial_components: int | None = Field(None, ge=0, le=1000, description="Exactly so many, in place of the share.")
    spatial_coefficients: int | None = Field(
        None, ge=4, le=10_000, description="Of each channel's spline; default: a fifth of the frames, at least 7."
    )
    temporal_share: Share = Field(0.99, description="Share of the variance that the time components hold.")
    most_temporal_components: int = Field(3, ge=0, le=1000, description="The time components are at most so many.")
    temporal_coefficients: int = Field(8, ge=4, le=1000, description="Of the spline of the time function.")
    temporal_weight: float | None = Field(
        None, ge=1e-3, le=1e3, allow_inf_nan=False, description="Of time in latent vectors; default: as much as space."
    )
    criterion: Literal["bic", "aic"] = Field("bic", description="What chooses the number of mixture components.")
    most_mixture_components: int = Field(10, ge=1, le=100, description="Tried at most.")
    mixture_components: int | None = Field(None, ge=1, le=100, description="Exactly so many, in place of a choice.")
    regularisation: float = Field(
        1e-4, ge=1e-12, le=1, allow_inf_nan=False, description="Added to variances, as a share of the mean variance."
    )
    starts: int = Field(5, ge=1, le=100, description="Of expectation maximisation; the best counts.")
    leave_one_out: bool = Field(True, description="Measure how well each example is reconstructed by the others.")
    folds: int = Field(5, ge=0, le=100, description="Parts held out in turn for likelihoods; 0: none.")
    report_samples: int = Field(200, ge=0, le=10_000, description="Drawn to measure feet and durations.")
    report: bool = Field(True, description="Write the report and its figures.")
    search_check: bool = Field(
        True, description="For the report: search for places that examples reached, by a model without them."
    )


MOST_TREE_SAMPLES = 100_000


class TreeParams(Request):
    """Parameters of `tree`."""

    samples: int = Field(10_000, ge=1, le=MOST_TREE_SAMPLES, description="Drawn from the model.")
    branching: int = Field(4, ge=2, le=64, description="Children of a node, at most.")
    leaf_size: int = Field(1, ge=1, le=MOST_TREE_SAMPLES, description="Nodes of so few samples are not split.")
    depth: int = Field(64, ge=1, le=64, description="Levels below the root, at most.")
    features: Literal["end_effectors", "latent"] = Field(
        "end_effectors", description="What is grouped: where hands, feet and head are, or the spatial scores."
    )

    def unclear_place(self, into: str) -> str | None:
        """Why the tree cannot go into this collection."""
        return f"a tree becomes a part of its model and cannot go to {into}; leave `into` empty" if into else None


class EditParams(Request):
    """Parameters of `edit`."""

    commands: tuple[EditCommand, ...] = Field(
        (), max_length=MOST_COMMANDS, description="What to do, in order, where the input `edit` does not say it."
    )
    in_place: bool = Field(
        False, description="Make each result the next revision of its clip; otherwise it is a clip of its own."
    )
    suffix: NameSuffix = Field("", description="Appended to the names.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.in_place and self.suffix:
            raise ValueError("suffix: results that take the place of their clips keep their names")
        return self

    def unclear_place(self, into: str) -> str | None:
        """Why results that go into this collection would change the clips themselves unasked, or not though asked."""
        if self.in_place and into:
            return f"the results cannot both take the place of the clips and go to {into}"
        if not (self.in_place or into or self.suffix):
            return "the results would take the place of the clips; give a folder or a suffix, or in_place"
        return None


class ImportParams(ImportOptions):
    """Parameters of `import`."""

    files: tuple[ImportFile, ...] = Field(min_length=1, max_length=10_000, description="Names and digests.")


class RetargetParams(Request):
    """Parameters of `retarget`."""

    scale: float | None = Field(None, gt=0, lt=1000, description="Root scale; absent: ratio of the hip heights.")
    suffix: NameSuffix = Field("", description="Appended to the names of the results.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")


class ExportParams(Request):
    """Parameters of `export`: one archive of files."""

    format: ExportFormat = Field("bvh", description="Format of the files.")
    unit: WrittenUnit = Field("cm", description="Unit of length where the format leaves it open.")
