"""Comparisons of runs of a script: tables of settings and fields, replicates with intervals, curves over steps."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Answer
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.queue.scripts import LONGEST_NAME, Value
from marey_schemas.sizes import KIB

MOST_COMPARED = 100
"""Greatest number of runs in a comparison."""
MOST_CURVES = 20
"""Greatest number of fields whose curves the result of a run contains: the first fields that the script logs."""
MOST_POINTS = 256
"""Greatest number of points of a stored curve; of longer curves, only some points are stored."""
MOST_CURVE_BYTES = 512 * KIB
"""Greatest size in bytes of the file with the curves of a run."""
LAST_STEP = 2**53
"""Greatest number of a step. Programs that read JSON numbers as double-precision floats read it exactly."""
MOST_DRAWN = 6
"""Greatest number of fields whose curves a comparison contains."""

Goal = Literal["highest", "lowest"]
GOALS: tuple[Goal, ...] = ("highest", "lowest")
Source = Literal["input", "value", "field", "commit"]


class Curve(Answer):
    """Values of a field over the steps of a run."""

    steps: tuple[Annotated[int, Field(ge=-LAST_STEP, le=LAST_STEP)], ...] = Field(
        max_length=MOST_POINTS, description="Steps in ascending order."
    )
    values: tuple[Annotated[float, Field(allow_inf_nan=False)] | None, ...] = Field(
        max_length=MOST_POINTS, description="The value at each step; null where it is not a finite number."
    )
    logged: int = Field(
        ge=0,
        le=LAST_STEP,
        description="Number of values that the script logged; a long curve contains only some of them.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.steps) != len(self.values):
            raise ValueError("a curve must have one value for each step")
        if any(one >= following for one, following in pairwise(self.steps)):
            raise ValueError("the steps of a curve must be in ascending order, each only once")
        return self


class Curves(Answer):
    """Curves (values over steps) of a run, by the name of the logged field."""

    curves: dict[Annotated[str, StringConstraints(max_length=LONGEST_NAME)], Curve] = Field(max_length=MOST_CURVES)


class ComparedColumn(Answer):
    """Column of a comparison: an input, a parameter, a logged field, or the commit."""

    name: str
    of: Source
    differs: bool = Field(description="Whether the runs have different values.")
    numeric: bool = Field(description="Whether all values are numbers.")
    goal: Goal | None = Field(
        None, description="Whether the highest or the lowest value of the field is the best; absent: not known."
    )
    best: float | None = Field(None, description="Best value of the field in a single run.")
    best_mean: float | None = Field(None, description="Best mean of the field over the runs of a setting.")


class ComparedRun(Answer):
    """Run of a script in a comparison, with its parameters and the fields that it logged."""

    job: str
    commit: str
    seed: int
    created_at: datetime
    inputs: dict[str, str] = Field(
        description="Path and revision of the item of each input, such as `raw/walk@2`. If an input does not have "
        "exactly one item: the number of its items, and a hash of their list."
    )
    values: dict[str, Value] = Field(description="Values of the parameters.")
    fields: dict[str, Value] = Field(description="Logged fields.")
    setting: int = Field(description="Index of the setting in `settings`.")
    counted: bool = Field(
        description="Whether the means of the setting include this run. Of several runs with the same seed, the "
        "means include only the newest, because a repetition with the same seed is no further sample."
    )
    curves: dict[str, Curve] = Field({}, description="Curves of the requested fields.")

    def cell(self, column: ComparedColumn) -> Value | None:
        """Return the value of this run in a column; None if the run has no value there."""
        if column.of == "commit":
            return self.commit
        if column.of == "input":
            return self.inputs.get(column.name)
        return (self.values if column.of == "value" else self.fields).get(column.name)


class FieldSummary(Answer):
    """Mean of a field over the runs of a setting, with its 95 % confidence interval."""

    n: int = Field(description="Number of runs with different seeds.")
    mean: float
    low: float | None = Field(
        None, description=f"Lower end of the interval; absent: fewer than {LEAST_REPLICATES} runs."
    )
    high: float | None = Field(
        None, description=f"Upper end of the interval; absent: fewer than {LEAST_REPLICATES} runs."
    )


class ComparedSetting(Answer):
    """Runs with the same command, inputs and parameters, which differ only by their seeds."""

    runs: tuple[int, ...] = Field(
        description="Indices in `runs` of the counted runs: of the newest run with each seed."
    )
    repeats: int = Field(description="Number of further runs, which have the same seed as a counted run.")
    fields: dict[str, FieldSummary] = Field(
        description="Mean and interval of each numeric field over the counted runs, by the name of the field."
    )


class RunComparison(Answer):
    """Comparison of the succeeded runs of a script: columns, runs, and settings with means over replicates."""

    subject: str = Field(description="Name of the script.")
    columns: tuple[ComparedColumn, ...]
    runs: tuple[ComparedRun, ...] = Field(description="Runs in the requested order.")
    settings: tuple[ComparedSetting, ...] = Field(description="Settings in the order of their first runs.")
    curves: tuple[str, ...] = Field((), description="Fields whose curves the runs contain.")
    complete: bool = Field(description="Whether `runs` contains all succeeded runs of the script.")

    def titles(self, columns: Sequence[ComparedColumn]) -> tuple[str, ...]:
        """Return the titles of columns: their names, or names such as `value.path` if several columns have one name."""
        names = [column.name for column in self.columns]
        return tuple(
            column.name if names.count(column.name) == 1 else f"{column.of}.{column.name}" for column in columns
        )


def number_of(value: Value | None) -> float | None:
    """Return a value as a number; None if it is a text, a truth value, missing or too large."""
    if isinstance(value, bool | str) or value is None:
        return None
    try:
        return float(value)
    except OverflowError:
        return None
