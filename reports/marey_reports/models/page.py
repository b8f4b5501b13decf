"""Reports of models for people: one HTML file each, which needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.verdict import verdict_of
from marey_motion.version import code_version
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.markup import element
from marey_reports.drawing.page import Section, page
from marey_reports.models.chapters import (
    example_chapter,
    headline,
    making_chapter,
    motion_chapter,
    numbers_chapter,
    variation_chapter,
    warning_chapter,
)
from marey_reports.models.definitions import definitions
from marey_reports.models.figures.subjects import ModelSubject
from marey_reports.models.provenance import provenance

__all__ = ["render_model_report"]


def render_model_report(
    trained: TrainedPrimitive,
    subject: ModelSubject,
    figures: Mapping[str, DrawnFigure],
    *,
    title: str,
    origin: Mapping[str, Any],
) -> str:
    """The report of a model as an HTML document.

    Parameters
    ----------
    subject : the same model with its examples
    figures : by name, as `draw_alignment_figures` and `draw_model_figures` give them. Those that are missing leave no
        gap
    title : heading of the page, for example the name of the model
    origin : where the examples come from, as the part `model` says it
    """
    sections = [
        warning_chapter(trained),
        motion_chapter(subject, figures),
        variation_chapter(subject, figures),
        example_chapter(subject, figures),
        making_chapter(subject, figures),
        numbers_chapter(figures),
        Section("definitions", "What the words and numbers mean", definitions()),
        Section("provenance", "Where this comes from", provenance(trained, origin)),
    ]
    lead = element("p", verdict_of(trained), class_="verdict"), headline(trained)
    return page(title, lead, sections, f"Written by Marey {code_version()}.")
