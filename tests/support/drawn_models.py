"""Trained models for tests of reports and figures. The model of generated walks is made once per process; only read it.

Training a model and drawing its figures takes seconds, so test files that do this are in the group `DRAWN_MODELS`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType

import pytest
from tests.support.model_examples import walks

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.modelling.training import TrainedPrimitive, train_primitive
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.models.figures import ModelSubject, draw_alignment_figures, draw_model_figures
from marey_schemas.options.modelling import ModelOptions

DRAWN_MODELS = pytest.mark.xdist_group("models of walks that are drawn")
QUICK = ModelOptions(report_samples=20, starts=1)


def trained_on(aligned: AlignedSet, options: ModelOptions = QUICK) -> tuple[TrainedPrimitive, ModelSubject]:
    """Train a model of these examples; return the model, and the data that its figures show."""
    trained = train_primitive(aligned, options, name="walk")
    return trained, ModelSubject(trained.primitive, aligned, trained.report, seed=3)


def figures_of(subject: ModelSubject) -> dict[str, DrawnFigure]:
    """Return every figure of a model and of the alignment of its examples, by name."""
    return {**draw_alignment_figures(subject.examples), **draw_model_figures(subject)}


@functools.cache
def model_of_walks() -> tuple[TrainedPrimitive, ModelSubject]:
    """Return a model that was trained on generated walks."""
    return trained_on(walks())


@functools.cache
def figures_of_walks() -> Mapping[str, DrawnFigure]:
    """Return the figures of the model of generated walks."""
    return MappingProxyType(figures_of(model_of_walks()[1]))
