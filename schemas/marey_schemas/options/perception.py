"""Options of comparisons of clips by a perceptual metric."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Options
from marey_schemas.documents.metrics import BuiltInMetric

DEFAULT_METRIC: BuiltInMetric = "published/positions-sigmoid"
"""Metric of a comparison if none is chosen: the one that agrees best with the published judgements.

Pražák et al. (2009) print no shares by which angles, positions and velocities could be combined.
"""


class MetricChoice(Options):
    """Choice of a built-in perceptual metric; a job with a stored metric gets it as the input `metric` instead."""

    metric: BuiltInMetric | None = Field(
        None,
        description="Name of a built-in perceptual metric, such as `published/sigmoid` or "
        "`published/positions-manhattan`; the input `metric` gives a stored metric instead.",
    )


class DistanceOptions(Options):
    """Options of perceptual distances between clips."""

    cycles: Literal["cut", "whole"] = Field(
        "cut",
        description="cut: cut a loop of one cycle out of each clip that is no loop, and compare the loops, as people "
        "saw them in the published experiment; whole: compare the clips from their first to their last frames.",
    )
