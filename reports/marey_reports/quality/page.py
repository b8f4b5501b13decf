"""Report of the quality of clips as one HTML file, which loads no other file, and as a CSV table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from marey_reports.drawing.drawn import DrawnFigure, as_csv
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.tables import Cell, facts, folded, number, table
from marey_reports.quality.figures import DRAWN_MEASURES, draw_clips, draw_travel
from marey_schemas.documents.quality import (
    MAIN_MEASURE,
    MEASURES,
    MeasuredSet,
    QualityChange,
    QualityDocument,
    QualityTotal,
    command_with,
    worst_clips_first,
)
from marey_schemas.wording import counted

MOST_LISTED = 200


def draw_quality_figures(document: QualityDocument) -> dict[str, DrawnFigure]:
    """Draw the bars of clips, and the seconds by speed and turn rate; return the figures by name."""
    return {
        "clips": DrawnFigure(draw_clips(document), "clips", "", "Clips, the worst first"),
        "travel": DrawnFigure(draw_travel(document), "travel", "", "Speed and turn rate"),
    }


def render_quality(
    document: QualityDocument,
    figures: Mapping[str, DrawnFigure],
    *,
    title: str,
    inputs: Sequence[ReportInput] = (),
) -> str:
    """Render the report as an HTML document.

    Parameters
    ----------
    document : the measured clips
    figures : figures by name, as returned by `draw_quality_figures`
    title : heading of the page
    inputs : the measured revisions, for the head
    """
    sections = [
        Section("totals", "Totals", _totals(document)),
        Section("clips", "Clips", (shown(figures, "clips"), _clips(document))),
        Section("travel", "Speed and turn rate", shown(figures, "travel")),
        Section("meaning", "What the numbers mean, and how they mislead", _meanings()),
        Section("conditions", "Conditions", _conditions(document)),
    ]
    if document.refused:
        sections.insert(2, Section("refused", "Clips that could not be measured", _refused(document)))
    lead = element("p", verdict(document), class_="verdict"), _headline(document)
    return page(ReportHead("Quality of clips", title, document.code_version, inputs), lead, sections)


def quality_csv(document: QualityDocument) -> str:
    """Return a CSV table with one row for each clip; the clips of the reference follow the measured clips."""
    sets = [("clip", document.measured), *([("reference", document.reference)] if document.reference else [])]
    rows = [(role, clip) for role, one in sets for clip in one.clips]
    columns = {
        "role": [role for role, _ in rows],
        **{
            name: [getattr(clip, name) for _, clip in rows]
            for name in ("name", "item", "revision", "take", "seconds", "frames", "frame_rate_hz")
        },
        **{name: [clip.values[name] for _, clip in rows] for name in MEASURES},
    }
    return as_csv(columns)


def verdict(document: QualityDocument) -> str:
    """Return one or two sentences about the main measure, and about its difference from the reference."""
    measure, total = MEASURES[MAIN_MEASURE], document.measured.totals[MAIN_MEASURE]
    said = f"{measure.title[0].upper()}{measure.title[1:]}: {_with_interval(total, measure.digits)} {measure.unit}."
    change = document.changes.get(MAIN_MEASURE)
    if document.reference is None or change is None:
        return f"{said} Without a reference, the report cannot say whether this is more than in recorded motion."
    other = document.reference.totals[MAIN_MEASURE]
    said += f" The reference has {_with_interval(other, measure.digits)} {measure.unit}"
    if change.low is None or change.high is None:
        return f"{said}; there are too few takes to say whether the difference is chance."
    if change.low <= 0.0 <= change.high:
        return f"{said}; the difference is within chance."
    return f"{said}, which is {'less' if change.value > 0.0 else 'more'}."


def _with_interval(total: QualityTotal, digits: int) -> str:
    if total.value is None:
        return "undefined"
    if total.low is None or total.high is None:
        return f"{total.value:,.{digits}f}"
    return f"{total.value:,.{digits}f} ({total.low:,.{digits}f} to {total.high:,.{digits}f})"


def _headline(document: QualityDocument) -> Html:
    def of(one: MeasuredSet) -> tuple[str, str]:
        takes = len({clip.take for clip in one.clips})
        minutes = sum(clip.seconds for clip in one.clips) / 60.0
        return str(len(one.clips)), f"{counted(takes, 'take')}, {minutes:,.1f} min"

    tiles = [("clips", *of(document.measured))]
    if document.reference is not None:
        tiles.append(("reference clips", *of(document.reference)))
    tiles.append(("refused", str(len(document.refused)), "could not be measured"))
    tiles.append(("measured at", f"{document.conditions.options.rate_hz:g} Hz", document.conditions.code))
    return facts(tiles)


def _totals(document: QualityDocument) -> Html:
    heads = ["measure", "unit", "mean", "95 % interval", "clips"]
    if document.reference is not None:
        heads += ["reference", "95 % interval", "difference", "95 % interval"]
    rows = [list(_total_row(document, name)) for name in MEASURES]
    note = (
        'Means over clips, weighted by their duration. Intervals are from draws of whole takes. The column "clips" '
        "has the number of clips in which a measure is defined."
    )
    if document.reference is not None:
        note += " Bold differences are worse than the reference, beyond chance."
    numbers = [column for column in range(2, len(heads)) if heads[column] != "95 % interval"]
    return joined((element("p", note), table("Totals", heads, rows, numbers=numbers, sortable=False)))


def _total_row(document: QualityDocument, name: str) -> Iterator[Cell]:
    measure, total = MEASURES[name], document.measured.totals[name]
    yield measure.title
    yield measure.unit or "share"
    yield number(total.value, measure.digits)
    yield _ends(total, measure.digits)
    yield number(total.clips, 0)
    if document.reference is not None:
        other, change = document.reference.totals[name], document.changes.get(name)
        yield number(other.value, measure.digits)
        yield _ends(other, measure.digits)
        look = "bad" if change is not None and is_worse(name, change) else ""
        yield number(None if change is None else change.value, measure.digits, signed=True, look=look)
        yield _ends(change, measure.digits)


def _ends(one: QualityTotal | QualityChange | None, digits: int) -> str:
    if one is None or one.low is None or one.high is None:
        return "–"
    return f"{number(one.low, digits).written} to {number(one.high, digits).written}"


def is_worse(name: str, change: QualityChange) -> bool:
    """Return whether the measured total is worse than the reference, and the interval of the difference excludes 0."""
    if change.low is None or change.high is None:
        return False
    better = MEASURES[name].better
    return (better == "less" and change.low > 0.0) or (better == "more" and change.high < 0.0)


def _clips(document: QualityDocument) -> Html:
    ordered = worst_clips_first(document.measured.clips)
    names = [*DRAWN_MEASURES, "speed_m_s"]
    heads = ("clip", "length (s)", *(_headed(name) for name in names))
    rows: list[Sequence[Cell]] = [
        (clip.name, number(clip.seconds, 1), *(number(clip.values[name], MEASURES[name].digits) for name in names))
        for clip in ordered[:MOST_LISTED]
    ]
    caption = "Clips" if len(ordered) <= MOST_LISTED else f"The worst {MOST_LISTED} clips; the CSV table has all"
    notes = list(dict.fromkeys(note for clip in ordered for note in clip.notes))
    listed = element("ul", [element("li", _noted(document, note)) for note in notes]) if notes else ""
    return joined((table(caption, heads, rows, numbers=range(1, len(heads))), listed))


def _noted(document: QualityDocument, note: str) -> str:
    count = sum(note in clip.notes for clip in document.measured.clips)
    return f"{counted(count, 'clip')}: {note}"


def _headed(name: str) -> str:
    measure = MEASURES[name]
    return f"{measure.title} ({measure.unit})" if measure.unit else measure.title


def _refused(document: QualityDocument) -> Html:
    rows = [(one["name"], one["detail"]) for one in document.refused]
    return table("Refused clips", ("clip", "reason"), rows, numbers=(), sortable=False)


def _meanings() -> Html:
    rows = [(_headed(name), measure.meaning, measure.source, measure.misleads) for name, measure in MEASURES.items()]
    return table("Measures", ("measure", "meaning", "source", "how it misleads"), rows, numbers=(), sortable=False)


def _conditions(document: QualityDocument) -> Html:
    conditions = document.conditions
    tree = {**conditions.model_dump(exclude={"options"}), **conditions.options.model_dump()}
    rows = [("code version", document.code_version), *((name, f"{value}") for name, value in tree.items())]
    note = element("p", "Numbers that were measured under other conditions are not compared. Repeat with: ")
    command = element("p", element("code", command_with(conditions)))
    return joined((note, command, folded("All conditions", table("Conditions", ("name", "value"), rows, numbers=()))))
