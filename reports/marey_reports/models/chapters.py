"""The chapters of the report of a model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from marey_motion.arrays import CM_PER_M
from marey_motion.modelling.sample_quality import FootQuality
from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.training_report import ExampleReport
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.markup import Content, Html, coded, element
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
    normals = counted(len(primitive.mixture.weights), "normal distribution")
    return facts(
        (
            ("examples", str(len(report.examples)),
             f"of {counted(report.takes, 'take')}; {f'{odd} unusual' if odd else 'none unusual'}"),
            ("error of a left-out take", *_unseen(trained)),
            ("duration of the examples", f"{durations.least_s:.1f}–{durations.most_s:.1f} s", lasting),
            ("dimensions", str(primitive.dimensions),
             f"{primitive.spatial.count} of poses, {primitive.temporal.count} of time; {normals}"),
            ("sliding of feet in samples", *_sliding(report.sample_feet, report.training_feet)),
        )
    )  # fmt: skip


def _unseen(trained: TrainedPrimitive) -> tuple[str, str]:
    errors, kept = trained.report.reconstruction, trained.primitive.spatial.count
    if errors is None:
        return "–", "not measured"
    at = min(kept, len(errors.components) - 1)
    by_subject = errors.left_out_subject_cm
    others = "" if by_subject is None else f"of a left-out performer: {by_subject[at]:.1f} cm; "
    others += f"of a training example: {errors.training_cm[at]:.1f} cm"
    if errors.left_out_cm is None:
        return "–", f"unknown: all examples come from one take; {others}"
    return f"{errors.left_out_cm[at]:.1f} cm", others


def _sliding(samples: FootQuality | None, examples: FootQuality | None) -> tuple[str, str]:
    if samples is None or examples is None:
        return "–", "not measured"
    return (
        f"{CM_PER_M * samples.slide_m_s:.0f} cm/s",
        f"in examples: {CM_PER_M * examples.slide_m_s:.0f} cm/s",
    )


def warning_chapter(trained: TrainedPrimitive) -> Section:
    """Write the chapter on the warnings about the model."""
    if not trained.warnings:
        text = element("p", "There are no warnings.")
        return Section("look", "Warnings", text)
    items = [
        element("li", coded(f"{warning.message[:1].upper()}{warning.message[1:]}. "), element("code", warning.code))
        for warning in trained.warnings
    ]
    return Section("look", "Warnings", element("ul", items))


def motion_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on samples of the model, and on the regions of space that hands and feet reach in them."""
    text = element(
        "p",
        "Left and right are the sides of the body: the left side is blue, the right side orange. All motions begin "
        "at the origin and face forward.",
    )
    reaches = reach_of(subject)
    heads = (
        "joint",
        *(f"{what}, {kind} (cm)" for what in ("sideways", "up", "forward") for kind in ("examples", "samples")),
    )
    rows = [_reach_row(reach) for reach in reaches]
    listing = table(
        "Range of hands and feet (1 % to 99 % quantiles); left, up and forward are positive",
        heads,
        rows,
        numbers=range(1, len(heads)),
        sortable=False,
    )
    pictures = shown(figures, "samples", "mean", "paths")
    return Section(
        "motions",
        "Generated motions",
        (text, pictures, listing, _comparison(subject), shown(figures, "search-errors", "durations")),
    )


def _comparison(subject: ModelSubject) -> Html | None:
    """Write the table that compares samples with examples; None without samples."""
    found, report = subject.report.comparison, subject.report
    if found is None:
        return None
    rows: list[list[Cell]] = [
        ["distance from the nearest example, of another take for examples (cm)", number(found.nearest_cm, 1),
         number(found.nearest_example_cm, 1)],
        ["diversity: mean distance of two motions (cm)", number(found.diversity_cm, 1),
         number(found.example_diversity_cm, 1)],
        ["rotations of joints beyond the range of the examples (%)", number(100.0 * found.beyond_range_share, 1), ""],
        ["greatest difference of the distributions of durations (%)", number(100.0 * found.duration_gap, 0), ""],
    ]  # fmt: skip
    if report.sample_feet is not None and report.training_feet is not None:
        feet = [number(CM_PER_M * one.slide_m_s, 1) for one in (report.sample_feet, report.training_feet)]
        rows.append(["sliding of planted feet (cm/s)", *feet])
    if report.held_out_low_share is not None:
        shares = {"takes": report.held_out_low_share, "performers": report.held_out_subject_low_share}
        rows += [
            [f"less likely than 95 % of what the model expects; examples of unseen {whose} (%)", number(5.0, 0),
             number(100.0 * share, 0)]
            for whose, share in shares.items() if share is not None
        ]  # fmt: skip
    heads = ("measure", "samples", "examples")
    return table("Samples beside examples", heads, rows, numbers=(1, 2), sortable=False)


def _reach_row(reach: Reach) -> list[Cell]:
    cells: list[Cell] = [reach.joint]
    for axis in range(3):
        for low, high in (reach.examples_m[axis], reach.samples_m[axis]):
            cells.append(Number(float(low), f"{CM_PER_M * low:+.0f} to {CM_PER_M * high:+.0f}"))
    return cells


def variation_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the effects of the first components of the model, one by one."""
    spatial, temporal = subject.primitive.spatial.count, subject.primitive.temporal.count
    if not spatial + temporal:
        text = "The model has no components: all examples are the same motion, and so are all samples."
        return Section("variation", "Components", element("p", text))
    text = (
        f"A motion of this model is {counted(spatial, 'number')} for its poses and {counted(temporal, 'number')} for "
        "its time, one for each component. The figures show the effects of the first components, which vary most."
    )
    components = [name for name in figures if name.startswith("component-")]
    return Section("variation", "Components", (element("p", text), shown(figures, *components, "time-components")))


def example_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the fit of each example, the least likely first."""
    examples = subject.report.examples
    order = sorted(range(len(examples)), key=lambda place: (_log_likelihood(examples[place]), examples[place].uid))
    rows = [_example_row(examples[place], subject.names[place]) for place in order]
    heads = ("example", "unusual", "log-likelihood", "left-out error (cm)", "alignment (cm)", "duration (s)")
    listing: Content = table("The examples, the least likely first", heads, rows[:MOST_ROWS], numbers=range(2, 6))
    if len(rows) > MOST_ROWS:
        everything = table("All examples", heads, rows, numbers=range(2, 6))
        listing = (listing, folded(f"All {len(rows)} examples", everything))
    text = (
        "An unusual example may show another action, an error of the recording or of the alignment, or a rare "
        "variation. Check it, and remove it if it does not show this action."
    )
    return Section("examples", "Unusual examples", (element("p", text), shown(figures, "likelihood"), listing))


def _log_likelihood(example: ExampleReport) -> float:
    held_out = example.held_out_log_likelihood
    return example.log_likelihood if held_out is None else held_out


def _example_row(example: ExampleReport, name: str) -> list[Cell]:
    return [
        element("span", name, title=example.uid),
        element("b", "unusual", class_="bad") if example.outlier else "",
        number(_log_likelihood(example), 1, look="bad" if example.outlier else ""),
        number(example.left_out_error_cm, 1),
        number(CM_PER_M * float(np.sqrt(max(example.alignment_cost, 0.0))), 1),
        number(example.duration_s),
    ]


def making_chapter(subject: ModelSubject, figures: Figures) -> Section:
    """Write the chapter on the alignment of the examples."""
    aligned = subject.examples
    reference = next(clip.name for clip in aligned.clips if clip.uid == aligned.reference)
    text = (
        f"{counted(len(aligned.clips), 'clip')}, aligned in place, direction and time with {reference}: "
        f"{aligned.frame_count} canonical frames at {aligned.frame_rate_hz:g} Hz."
    )
    keys = sorted(aligned.keyframes.items(), key=lambda each: (each[1], each[0]))
    listing = None
    if keys:
        rows = [(label, number(float(frame), 0), number(frame / aligned.frame_rate_hz)) for label, frame in keys]
        heads = ("keyframe", "canonical frame", "in the reference (s)")
        listing = table("Keyframes that all examples share", heads, rows, numbers=(1, 2), sortable=False)
    pictures = shown(figures, "time-warps", "alignment-costs")
    return Section("making", "Alignment of the examples", (element("p", text), listing, pictures))


def numbers_chapter(figures: Figures) -> Section:
    """Write the chapter on the size of the model: variance, errors of reconstruction, latent space and mixture."""
    pictures = shown(figures, "variance", "reconstruction", "latent-space", "mixture")
    return Section("numbers", "Size and accuracy", pictures)
