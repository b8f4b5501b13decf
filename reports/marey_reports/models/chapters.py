"""The chapters of the report of a model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from marey_motion.arrays import CM_PER_M
from marey_motion.modelling.sample_quality import FootQuality
from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.training_report import ExampleReport
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.markup import Content, Html, element
from marey_reports.drawing.page import Section, shown
from marey_reports.drawing.tables import Cell, Number, facts, folded, number, table
from marey_reports.models.figures.latent_space import MOST_ROWS
from marey_reports.models.figures.samples import Reach, reach_of
from marey_reports.models.figures.subjects import ModelSubject
from marey_schemas.wording import counted

Figures = Mapping[str, DrawnFigure]


def headline(trained: TrainedPrimitive) -> Html:
    """Return the summary of the most important numbers as HTML."""
    primitive, report = trained.primitive, trained.report
    durations, drawn = report.training_durations, report.sample_durations
    lasting = "" if drawn is None else f"samples {drawn.least_s:.1f}–{drawn.most_s:.1f} s"
    odd = sum(example.outlier for example in report.examples)
    kinds = counted(len(primitive.mixture.weights), "kind")
    return facts(
        (
            ("examples", str(len(report.examples)), f"{odd} odd" if odd else "none of them odd"),
            ("an unseen example is off by", *_unseen(trained)),
            ("how long it lasts", f"{durations.least_s:.1f}–{durations.most_s:.1f} s", lasting),
            ("numbers that make a motion", str(primitive.dimensions),
             f"{primitive.spatial.count} of poses, {primitive.temporal.count} of time; {kinds}"),
            ("feet of samples slide at", *_sliding(report.sample_feet, report.training_feet)),
        )
    )  # fmt: skip


def _unseen(trained: TrainedPrimitive) -> tuple[str, str]:
    errors, kept = trained.report.reconstruction, trained.primitive.spatial.count
    if errors is None or len(trained.report.examples) < 2:
        return "–", "not measured"
    at = min(kept, len(errors.components) - 1)
    return f"{errors.left_out_cm[at]:.1f} cm", f"one that it was made of by {errors.training_cm[at]:.1f} cm"


def _sliding(samples: FootQuality | None, examples: FootQuality | None) -> tuple[str, str]:
    if samples is None or examples is None:
        return "–", "not measured"
    return (
        f"{CM_PER_M * samples.slide_m_s:.0f} cm/s",
        f"those of the examples at {CM_PER_M * examples.slide_m_s:.0f} cm/s",
    )


def warning_chapter(trained: TrainedPrimitive) -> Section:
    """Write the chapter on the warnings about the model."""
    if not trained.warnings:
        text = element("p", "Nothing stands out.")
        return Section("look", "What to look at", text)
    items = [
        element("li", f"{warning.message[:1].upper()}{warning.message[1:]}. ", element("code", warning.code))
        for warning in trained.warnings
    ]
    return Section("look", "What to look at", element("ul", items))


def motion_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the samples of the model and the space that they reach."""
    text = element(
        "p",
        "Left and right are those of the body: blue is its left side, orange its right. All motions begin where the "
        "axes cross and face forward.",
    )
    reaches = reach_of(subject)
    heads = (
        "joint",
        *(f"{what}, {kind} (cm)" for what in ("sideways", "up", "forward") for kind in ("examples", "samples")),
    )
    rows = [_reach_row(reach) for reach in reaches]
    listing = table(
        "Where hands and feet are in 98 of 100 moments; left, up and forward are positive",
        heads,
        rows,
        numbers=range(1, len(heads)),
        sortable=False,
    )
    pictures = shown(figures, "samples", "mean", "paths")
    return Section("motions", "What it makes", (text, pictures, listing, shown(figures, "search-errors", "durations")))


def _reach_row(reach: Reach) -> list[Cell]:
    cells: list[Cell] = [reach.joint]
    for axis in range(3):
        for low, high in (reach.examples_m[axis], reach.samples_m[axis]):
            cells.append(Number(float(low), f"{CM_PER_M * low:+.0f} to {CM_PER_M * high:+.0f}"))
    return cells


def variation_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the effect of each of the first components."""
    spatial, temporal = subject.primitive.spatial.count, subject.primitive.temporal.count
    if not spatial + temporal:
        text = "Nothing: all examples are the same motion, and so are all samples."
        return Section("variation", "What it can vary", element("p", text))
    text = (
        f"A motion of this model is {counted(spatial, 'number')} for its poses and {counted(temporal, 'number')} for "
        "its time. Each number turns one of the knobs below; the first ones turn most."
    )
    components = [name for name in figures if name.startswith("component-")]
    return Section(
        "variation", "What it can vary", (element("p", text), shown(figures, *components, "time-components"))
    )


def example_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the fit of each example, the least likely first."""
    examples = subject.report.examples
    order = sorted(range(len(examples)), key=lambda place: (-_oddness(examples[place]), examples[place].uid))
    rows = [_example_row(examples[place], subject.names[place]) for place in order]
    heads = ("example", "odd", "likelihood", "unseen error (cm)", "alignment (cm)", "duration (s)")
    listing: Content = table("The examples, the least likely first", heads, rows[:MOST_ROWS], numbers=range(2, 6))
    if len(rows) > MOST_ROWS:
        everything = table("All examples", heads, rows, numbers=range(2, 6))
        listing = (listing, folded(f"All {len(rows)} examples", everything))
    text = (
        "An example that is unlike the others may show another action, a mistake of the recording or of the "
        "alignment, or just something rare. Look at it, and leave it out if it does not belong here."
    )
    return Section("examples", "Which examples are odd", (element("p", text), shown(figures, "likelihood"), listing))


def _oddness(example: ExampleReport) -> float:
    held_out = example.held_out_log_likelihood
    return -(example.log_likelihood if held_out is None else held_out)


def _example_row(example: ExampleReport, name: str) -> list[Cell]:
    return [
        element("span", name, title=example.uid),
        element("b", "odd", class_="bad") if example.outlier else "",
        number(-_oddness(example), 1, look="bad" if example.outlier else ""),
        number(example.left_out_error_cm, 1),
        number(CM_PER_M * float(np.sqrt(max(example.alignment_cost, 0.0))), 1),
        number(example.duration_s),
    ]


def making_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the alignment of the examples."""
    aligned = subject.examples
    reference = next(clip.name for clip in aligned.clips if clip.uid == aligned.reference)
    text = (
        f"{counted(len(aligned.clips), 'clip')}, brought to one place, one direction and the time of {reference}: "
        f"{aligned.frame_count} canonical frames at {aligned.frame_rate_hz:g} Hz."
    )
    keys = sorted(aligned.keyframes.items(), key=lambda each: (each[1], each[0]))
    listing = None
    if keys:
        rows = [(label, number(float(frame), 0), number(frame / aligned.frame_rate_hz)) for label, frame in keys]
        heads = ("keyframe", "canonical frame", "in the reference (s)")
        listing = table("Keyframes that all examples share", heads, rows, numbers=(1, 2), sortable=False)
    pictures = shown(figures, "time-warps", "alignment-costs")
    return Section("making", "How the examples were aligned", (element("p", text), listing, pictures))


def numbers_chapter(figures: Figures) -> Section:
    """Write the chapter on the size of the model: variance, errors of reconstruction, latent space and mixture."""
    pictures = shown(figures, "variance", "reconstruction", "latent-space", "mixture")
    return Section("numbers", "How much it keeps", pictures)
