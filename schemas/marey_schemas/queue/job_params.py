"""Parameters of the built-in kinds of jobs: the options of each, and names and tags of the results."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from marey_schemas.base import Request
from marey_schemas.consents import ConsentOverride
from marey_schemas.editing.edits import MOST_COMMANDS, EditCommand
from marey_schemas.imports import ImportFile
from marey_schemas.names import (
    MAX_NAME_LENGTH,
    MOST_TAGS,
    ItemId,
    ItemName,
    Label,
    LayerName,
    NameSuffix,
    Tag,
    TrialName,
)
from marey_schemas.options.alignment import AlignOptions
from marey_schemas.options.annotations import Proposal, Seconds
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.exporting import MotionFileOptions
from marey_schemas.options.imports import ImportOptions
from marey_schemas.options.improvement import OptimisationOptions, SuggestionOptions, SweepOptions
from marey_schemas.options.matching import FeatureWeights
from marey_schemas.options.modelling import ModelOptions, TreeOptions
from marey_schemas.options.perception import DistanceOptions, MetricChoice
from marey_schemas.options.quality import QualityOptions
from marey_schemas.options.retargeting import RetargetOptions


class TaggedResults(Request):
    """Base of parameters with tags for the results."""

    tags: tuple[Tag, ...] = Field((), max_length=MOST_TAGS, description="Tags that the results get.")


class SuffixedResults(TaggedResults):
    """Base of parameters with a suffix for the names of the results, and tags."""

    suffix: NameSuffix = Field(
        "", description="Text that is appended to the name of each input to form the name of its result."
    )


class AlignParams(AlignOptions, MetricChoice, SuffixedResults):
    """Parameters of jobs of the kind `align`, which align examples of one action with each other."""

    layer: LayerName | None = Field(
        None, description="Layer of the annotations to use; required if a clip has annotations of several layers."
    )
    labels: tuple[Label, ...] = Field(
        (), max_length=1000, description="Labels of the segments and keyframes at which clips are divided; empty: all."
    )
    mirroring: Literal["none", "add"] = Field(
        "none",
        description="Mirrored copies of the clips. none: only the "
        "clips themselves are aligned; add: each clip and its mirrored copy.",
    )


_NAME_FIELD = re.compile(r"\{(clip|label|number)(?::([1-9]))?\}")


class AnnotateParams(TaggedResults):
    """Parameters of jobs of the kind `annotate`, which propose segments and keyframes of clips."""

    proposal: Proposal = Field(description="Method that proposes segments and keyframes.")
    layer: LayerName | None = Field(None, description="Name of the layer; default: the name of the method.")


class CutParams(TaggedResults):
    """Parameters of jobs of the kind `cut`, which cut clips along segments of annotations."""

    layer: LayerName | None = Field(None, description="Layer of the annotations to use; absent: all layers.")
    labels: tuple[Label, ...] = Field(
        (), max_length=1000, description="Labels of the segments to cut out; empty: all labels."
    )
    margin_before_s: Seconds = Field(
        0.0, description="Seconds before each segment that are also cut out, as far as the clip contains them."
    )
    margin_after_s: Seconds = Field(
        0.0, description="Seconds after each segment that are also cut out, as far as the clip contains them."
    )
    shortest_s: Seconds = Field(0.0, description="Shortest segment to cut out, in seconds.")
    longest_s: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = Field(
        None, description="Longest segment to cut out, in seconds; absent: no limit."
    )
    name: str = Field(
        "{clip}_{label}_{number:2}",
        min_length=1,
        max_length=MAX_NAME_LENGTH,
        description="Pattern of the pieces' names; {number:2} counts the segments of a label in a clip from "
        "1, with two digits.",
    )
    by_label: bool = Field(
        False, description="Put the pieces of each label into a separate subfolder, which has the name of the label."
    )

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        fields = {found.group(1) for found in _NAME_FIELD.finditer(name)}
        if fields != {"clip", "label", "number"}:
            raise ValueError(
                "the pattern of names must contain {clip}, {label} and {number}, so that every "
                "piece has a name of its own"
            )
        if set("{}/") & set(_NAME_FIELD.sub("", name)):
            raise ValueError(
                "the pattern of names must contain no slash, and no braces but those of "
                "{clip}, {label} and {number} (or {number:3} for three digits)"
            )
        return name

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        if self.longest_s is not None and self.longest_s < self.shortest_s:
            raise ValueError("longest_s must not be less than shortest_s")
        return self

    def piece_name(self, clip: str, label: str, number: int) -> str:
        """Return the name of the piece with this number, cut from a clip along a segment with this label."""
        given = {"clip": clip, "label": label.replace("/", "-")}

        def text(found: re.Match[str]) -> str:
            name, digits = found.groups()
            return given[name] if name in given else str(number).zfill(int(digits or 1))

        return _NAME_FIELD.sub(text, self.name)


MOST_TRIALS = 2000
MOST_SIMULATED_S = 100_000.0
"""Greatest total duration of all trials, in seconds. With default options, the trials take 5,346 s together."""
MOST_REPLICATED_S = 800_000.0
"""Greatest total duration of all replicates of all trials, in seconds: some minutes of a processor."""
TRIALS_PER_TASK = 8
MOST_EVALUATION_TASKS = 64


class EvaluateParams(EvaluationOptions, MetricChoice, TaggedResults):
    """Parameters of jobs of the kind `evaluate`, which evaluate locomotion clips by motion matching."""

    name: ItemName = Field("evaluation", description="Name of the result.")
    loops: tuple[ItemId, ...] = Field(
        (), max_length=100_000, description="Clips that are loops, in addition to those tagged `loop`."
    )
    trims: dict[ItemId, tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(gt=0)]]] = Field(
        default_factory=dict,
        max_length=100_000,
        description="Range of frames to use, as first frame and the "
        "frame after the last, by the id of the clip; "
        "other clips are used whole.",
    )
    baseline: bool = Field(
        True,
        description="For comparison, also run the trials with a baseline: generated clips that contain "
        "every speed and turn rate.",
    )
    report: bool = Field(True, description="Write the report and its figures.")
    trial_figures: tuple[TrialName, ...] = Field(
        (), max_length=16, description="Names of trials that get figures of their own, such as `circle v=1.25 w=-50`."
    )

    @property
    def trial_count(self) -> int:
        """The number of trials; of trials along takes, the greatest possible number."""
        takes = self.most_takes if "takes" in self.families else 0
        return takes + len(self.speeds_m_s) * sum(len(self.courses_deg(family)) for family in self.families)

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        if self.trial_count > MOST_TRIALS:
            raise ValueError(
                f"the speeds, turn rates and families make {self.trial_count} trials; at most {MOST_TRIALS} are allowed"
            )
        simulated_s = self.trial_count * (self.approach_s + self.duration_s)
        if simulated_s > MOST_SIMULATED_S:
            raise ValueError(
                f"{self.trial_count} trials of this length simulate {simulated_s:,.0f} s together; at most "
                f"{MOST_SIMULATED_S:,.0f} s are allowed"
            )
        if (replicated_s := simulated_s * self.replicates) > MOST_REPLICATED_S:
            raise ValueError(
                f"{self.replicates} replicates of {self.trial_count} trials of this length simulate "
                f"{replicated_s:,.0f} s together; at most {MOST_REPLICATED_S:,.0f} s are allowed, so choose fewer "
                "replicates"
            )
        for item, (start, stop) in self.trims.items():
            if stop <= start:
                raise ValueError(f"trims.{item}: the end, frame {stop}, must be after the start, frame {start}")
        return self


def count_evaluation_tasks(params: EvaluateParams) -> int:
    """Return the number of tasks of an evaluation; a task has few trials, so that a failure loses little work."""
    per_task = max(TRIALS_PER_TASK, -(-params.trial_count // MOST_EVALUATION_TASKS))
    return -(-params.trial_count // per_task)


WEIGHT_GROUPS = len(FeatureWeights.model_fields.keys() - {"extra_joints"})
"""Number of feature groups that every database has. The optional group of extra joints does not add tasks."""


class CompareParams(Request):
    """Parameters of jobs of the kind `compare`, which compare evaluations."""

    title: str = Field(
        "", max_length=200, description="Title of the report; default: the names of the two evaluations."
    )
    report: bool = Field(True, description="Write the report, a self-contained HTML page.")


class AnalyseStudyParams(Request):
    """Parameters of jobs of the kind `analyse_study`, which analyse the judgements of a study."""

    title: str = Field("", max_length=200, description="Title of the report; default: the title of the study.")
    report: bool = Field(True, description="Write the report, a self-contained HTML page.")
    draws: int = Field(
        1000,
        ge=0,
        le=10_000,
        description="Number of bootstrap samples of the participants, from which the intervals of the weights "
        "are computed.",
    )


MOST_COMPARED_CLIPS = 500
"""Greatest number of clips of a table of perceptual distances."""
CLIPS_PER_BLOCK = 50
"""Greatest number of clips of a block; a task compares the clips of two blocks with each other, or of one block."""


class DistancesParams(DistanceOptions, MetricChoice):
    """Parameters of jobs of the kind `distances`, which measure perceptual distances of clips."""

    loops: tuple[ItemId, ...] = Field(
        (), max_length=MOST_COMPARED_CLIPS, description="Clips that are loops, in addition to those tagged `loop`."
    )
    title: str = Field("", max_length=200, description="Title of the report; default: the names of the clips.")
    report: bool = Field(True, description="Write the report, a self-contained HTML page, and its figures.")


def count_distance_tasks(_params: DistancesParams, clips: int) -> int:
    """Return the number of tasks of a comparison: one for each pair of blocks of clips, and for each block alone.

    For more than `MOST_COMPARED_CLIPS` clips it is 1, a task that refuses the job.
    """
    if clips > MOST_COMPARED_CLIPS:
        return 1
    blocks = max(1, -(-clips // CLIPS_PER_BLOCK))
    return blocks * (blocks + 1) // 2


class QualityParams(QualityOptions):
    """Parameters of jobs of the kind `quality`, which measure defects of clips."""

    draws: int = Field(
        1000,
        ge=0,
        le=10_000,
        description="Number of bootstrap samples of the takes, from which the confidence intervals are computed.",
    )
    title: str = Field("", max_length=200, description="Title of the report; default: the number of clips.")
    report: bool = Field(True, description="Write the report, a self-contained HTML page, and its figures.")


class SuggestParams(SuggestionOptions, MetricChoice):
    """Parameters of jobs of the kind `suggest`, which find clips to remove from a set or to add."""

    report: bool = Field(True, description="Write the report, a self-contained HTML page.")


class OptimiseParams(OptimisationOptions):
    """Parameters of jobs of the kind `optimise`, which improve a set of clips step by step."""


class SweepParams(SweepOptions):
    """Parameters of jobs of the kind `sweep`, which repeat an evaluation with other weights."""


def count_sweep_tasks(params: SweepParams) -> int:
    """Return the number of tasks of a sweep: one for each setting of the weights."""
    return 1 + WEIGHT_GROUPS * len(params.factors)


class ModelParams(ModelOptions, TaggedResults):
    """Parameters of jobs of the kind `model`, which train a generative model of an action."""

    name: ItemName = Field("model", description="Name of the model, and also of the action that it generates.")
    report: bool = Field(True, description="Write the report and its figures.")
    search_check: bool = Field(
        True,
        description="For the report, test searches: leave out every fifth take, train a model on the other takes, and "
        "search for positions that the hands and feet reach in the left-out takes.",
    )


class TreeParams(TreeOptions):
    """Parameters of jobs of the kind `tree`, which build the sample tree of a model."""

    def unclear_place(self, into: str) -> str | None:
        """Return the reason why the tree cannot be stored in a collection, or None if it can."""
        return f"a tree is stored as a part of its model, not in {into}; leave `into` empty" if into else None


class EditParams(SuffixedResults):
    """Parameters of jobs of the kind `edit`, which apply commands to clips."""

    commands: tuple[EditCommand, ...] = Field(
        (),
        max_length=MOST_COMMANDS,
        description="Commands in the order of their application; required without the input `edit`.",
    )
    in_place: bool = Field(
        False, description="Make each result a new revision of its clip; otherwise each result is a new clip."
    )

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.in_place and self.suffix:
            raise ValueError(
                "suffix: must be empty when in_place is set, because in_place keeps the names of the clips"
            )
        return self

    def unclear_place(self, into: str) -> str | None:
        """Return the reason why `into`, `suffix` and `in_place` do not determine the place of the results, or None."""
        if self.in_place and into:
            return (
                f"with in_place the results replace the clips, so they cannot be stored in {into}; leave `into` empty, "
                "or set in_place to false"
            )
        if not (self.in_place or into or self.suffix):
            return (
                "the results would have the same folders and names as the clips; give a folder or a suffix, or set "
                "in_place"
            )
        return None


class ImportParams(ImportOptions):
    """Parameters of jobs of the kind `import`, which import files."""

    files: tuple[ImportFile, ...] = Field(
        min_length=1,
        max_length=10_000,
        description="The files to import, by name and digest; the server already has their bytes.",
    )


class IndexParams(Request):
    """Parameters of jobs of the kind `index`, which index the poses of clips for searches."""

    name: ItemName = Field("motion-index", description="Name of the index; an index with this name is replaced.")


class RetargetParams(RetargetOptions, SuffixedResults):
    """Parameters of jobs of the kind `retarget`, which transfer motions to another skeleton."""

    scale: float | None = Field(
        None, gt=0, lt=1000, description="Scale of the root's path; absent: the ratio of the hip heights."
    )


class ExportParams(MotionFileOptions, ConsentOverride):
    """Parameters of jobs of the kind `export`, which write clips to files in one archive."""
