"""Evaluations of locomotion clips: the parts of an item of the kind `evaluation`."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field

from marey_schemas.base import Request

COSTS = ("match_cost", "continuing_cost", "pose_cost")
"""Costs that the part `records` contains for each tick."""


class EvaluationDocument(Request):
    """Part `evaluation`: options, provenance, metrics of every trial, usage, coverage, baseline.

    Its members are those of `marey_motion.evaluation.result.EvaluationResult`, with arrays as leaves. This class
    declares only the members that lists and summaries show.
    """

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation@1"] = Field("marey/evaluation@1", alias="schema")
    verdict: str = Field(max_length=2000, description="Assessment of the clips in one or two sentences.")
    headline: dict[str, float | int | None] = Field(
        max_length=64, description="Numbers that lists of items show, by name."
    )


class EvaluationRecords(Request):
    """Part `records`: the ticks of all trials, one trial after the other."""

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation-records@1"] = Field("marey/evaluation-records@1", alias="schema")
