"""Report of perceptual distances: one HTML file, which needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from marey_motion.version import code_version
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.paper import labels_of
from marey_reports.drawing.tables import Cell, Number, facts, folded, number, table
from marey_reports.perception.compared import ComparedSet, drawn_pairs
from marey_reports.perception.distance_table import draw_distance_table
from marey_reports.perception.motion_maps import draw_components, draw_registration
from marey_schemas.documents.metrics import JOINT_CLASS_NAMES, MetricComponent, MetricIdentity
from marey_schemas.wording import counted

MOST_LISTED_PAIRS = 30
FORMULA = (
    "The distance of two poses is c + N · Σ w F(x): x is the difference of a joint class, F the shaping, w the weight "
    "of the class, and c a constant."
)


def draw_distance_figures(subject: ComparedSet) -> dict[str, DrawnFigure]:
    """Draw the table of distances of three clips or more, and the maps of the nearest and the farthest pair.

    Maps by component are drawn only for metrics with several components.
    """
    figures: dict[str, DrawnFigure] = {}
    if len(subject.clips) > 2:
        sketch = draw_distance_table(subject)
        figures["distances"] = DrawnFigure(sketch, "distances", "4", "Distances of all pairs")
    pairs = drawn_pairs(subject.distances)
    words = ("nearest", "farthest") if len(pairs) > 1 else ("",)
    for word, pair in zip(words, pairs, strict=True):
        one, other = subject.drawable(pair)
        start, end = (f"{word}-", f" of the {word} pair") if word else ("", "")
        registration = draw_registration(
            one,
            other,
            subject.computed,
            subject.drawn[pair[0]].period,
            subject.curve(pair),
            recorded=subject.recorded(pair[0]),
            rate_hz=subject.metric.frame_rate_hz,
        )
        name = f"{start}registration"
        figures[name] = DrawnFigure(registration, name, "1", f"Motion maps{end}")
        if len(subject.metric.components) > 1:
            name = f"{start}components"
            components = draw_components(one, other, subject.computed)
            figures[name] = DrawnFigure(components, name, "6", f"Motion maps by component{end}")
    return figures


def render_distances(
    subject: ComparedSet, figures: Mapping[str, DrawnFigure], *, title: str, inputs: Sequence[ReportInput] = ()
) -> str:
    """Render the report of a comparison as an HTML document.

    Parameters
    ----------
    subject : clips with their distances
    figures : figures by name, as returned by `draw_distance_figures`
    title : heading of the page
    inputs : the compared revisions, for the head
    """
    maps = [name for name in figures if name != "distances"]
    sections = [
        Section("distances", "Distances", (shown(figures, "distances"), _pairs(subject))),
        Section("maps", "Motion maps", shown(figures, *maps)),
        Section("meaning", "What the metric can and cannot say", _claims(subject)),
        Section("clips", "Clips", _clips(subject)),
        Section("metric", "The metric", _metric(subject)),
    ]
    lead = element("p", _verdict(subject), class_="verdict"), _headline(subject)
    return page(ReportHead("Perceptual distances of clips", title, code_version(), inputs), lead, sections)


def _verdict(subject: ComparedSet) -> str:
    ranked, totals = subject.distances.pairs_by_distance(), subject.distances.totals
    names = labels_of([clip.name for clip in subject.clips])
    (i, j), (k, m) = ranked[0], ranked[-1]
    if len(ranked) == 1:
        return f"The perceptual distance of {names[i]} and {names[j]} is {totals[i, j]:.3f}."
    return (
        f"Of {counted(len(subject.clips), 'clip')}, {names[i]} and {names[j]} have the smallest perceptual "
        f"distance, {totals[i, j]:.3f}; {names[k]} and {names[m]} the greatest, {totals[k, m]:.3f}."
    )


def _headline(subject: ComparedSet) -> Html:
    totals = subject.distances.totals[np.triu_indices(len(subject.clips), 1)]
    span = f"{totals.min():.3f} to {totals.max():.3f}" if len(totals) > 1 else f"{totals[0]:.3f}"
    cut = sum(clip.period_frames is not None for clip in subject.clips)
    return facts(
        (
            ("clips", str(len(subject.clips)), f"{counted(cut, 'loop')} of one cycle" if cut else "compared whole"),
            ("distances", span, "0: equal poses at all moments"),
            ("metric", subject.metric.name, subject.metric.origin),
        )
    )


def _pairs(subject: ComparedSet) -> Html:
    ranked = subject.distances.pairs_by_distance()
    names = labels_of([clip.name for clip in subject.clips])
    listed = ranked if len(ranked) <= MOST_LISTED_PAIRS else ranked[:MOST_LISTED_PAIRS]
    several = len(subject.metric.components) > 1  # of one, the distances are those of the metric
    measured = [component.measurement for component in subject.metric.components] if several else []
    parts = subject.distances.by_component if several else ()
    rows: list[Sequence[Cell]] = [
        (
            f"{names[i]} – {names[j]}",
            number(float(subject.distances.totals[i, j]), 3),
            *(number(float(part[i, j]), 3) for part in parts),
        )
        for i, j in listed
    ]
    caption = "Pairs, the nearest first" if len(listed) == len(ranked) else f"The {len(listed)} nearest pairs"
    heads = ("pair", "distance", *measured)
    return table(caption, heads, rows, numbers=range(1, len(heads)))


def _claims(subject: ComparedSet) -> Html:
    return element("ul", [element("li", claim) for claim in subject.claims()])


def _clips(subject: ComparedSet) -> Html:
    rate = subject.metric.frame_rate_hz
    rows: list[Sequence[Cell]] = [
        (
            clip.name,
            number(clip.recorded_frames / rate, 2),
            number(clip.compared_frames / rate, 2),
            number(None if clip.start_frame is None else clip.start_frame / rate, 2),
        )
        for clip in subject.clips
    ]
    return table(
        "What was compared", ("clip", "recorded (s)", "compared (s)", "loop begins (s)"), rows, numbers=range(1, 4)
    )  # fmt: skip


def _metric(subject: ComparedSet) -> Html:
    metric = subject.metric
    heads = ("measurement", "shaping", "share", "c", "N", *(name.replace("_", " ") for name in JOINT_CLASS_NAMES))
    rows: list[Sequence[Cell]] = [
        (
            component.measurement,
            component.shaping if component.shaping != "power" else f"power {component.exponent:.3g}",
            number(component.share, 3),
            number(component.constant, 3),
            number(component.norm, 3),
            *_weights(component),
        )
        for component in metric.components
    ]
    options = metric.model_dump(mode="json", include={
        "angle", "side_reduce", "identity", "root_alignment", "length_unit_m", "velocity_interval_s", "frame_rate_hz",
        "code_version",
    })  # fmt: skip
    conventions = [
        (name, f"{value:.6g}" if isinstance(value, float) else str(value)) for name, value in options.items()
    ]
    conventions.append(("digest", MetricIdentity.of(metric).digest))
    return joined(
        (
            table("Weights", heads, rows, numbers=range(2, len(heads)), sortable=False),
            element("p", FORMULA),
            folded("Conventions", table("Conventions", ("name", "value"), conventions, numbers=(), sortable=False)),
        )
    )


def _weights(component: MetricComponent) -> list[Number]:
    total = sum(component.weights.values())
    given = {str(name): weight / total for name, weight in component.weights.items()}
    return [number(given.get(name), 3) for name in JOINT_CLASS_NAMES]
