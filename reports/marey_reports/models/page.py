"""Reports of models for people. Each report is one HTML file, which needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.verdict import verdict_of
from marey_motion.version import code_version
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.page import Section, page
from marey_reports.drawing.tables import folded, table
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

__all__ = ["render_model_report"]
_ORIGINS = {"set": "aligned set", "reference": "reference", "seed": "seed"}


def render_model_report(
    trained: TrainedPrimitive,
    subject: ModelSubject,
    figures: Mapping[str, DrawnFigure],
    *,
    title: str,
    origin: Mapping[str, Any],
    inputs: Sequence[ReportInput] = (),
) -> str:
    """Render the report of a model as an HTML document.

    Parameters
    ----------
    trained : the model with its training report
    subject : the same model with its examples, for drawing
    figures : figures by name, as returned by `draw_alignment_figures` and `draw_model_figures`; some may be missing
    title : heading of the page, for example the name of the model
    origin : field `provenance` of the part `model`: origin of the model and of its examples
    inputs : the revisions that the model was made from, for the head
    """
    sections = [
        warning_chapter(trained),
        motion_chapter(subject, figures),
        variation_chapter(subject, figures),
        example_chapter(subject, figures),
        making_chapter(subject, figures),
        numbers_chapter(figures),
        Section("definitions", "Definitions", definitions()),
        Section("provenance", "Provenance", provenance(trained, origin)),
    ]
    lead = element("p", verdict_of(trained), class_="verdict"), headline(trained)
    return page(ReportHead("Model of motion", title, code_version(), inputs), lead, sections)


def provenance(trained: TrainedPrimitive, origin: Mapping[str, Any]) -> Html:
    """Describe the origin of the model: examples, options and code version."""
    known = [
        (label, element("code", str(origin[name]))) for name, label in _ORIGINS.items() if origin.get(name) is not None
    ]
    known.append(("version of the code", element("code", code_version())))
    options = [(name, _written(value)) for name, value in trained.options]
    clips = [
        (element("code", f"{clip['item']}@{clip['revision']}"), str(clip["name"])) for clip in origin.get("aligned", ())
    ]
    return joined(
        (
            element("p", "The same examples, options, seed and version of the code give the same model, bit for bit."),
            table("Origin", ("name", "value"), known, numbers=(), sortable=False),
            folded("All options", table("Options", ("option", "value"), options, numbers=(), sortable=False)),
            folded("Every example", table("Aligned clips", ("clip", "name"), clips, numbers=())) if clips else None,
        )
    )


def _written(value: object) -> str:
    return "chosen automatically" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
