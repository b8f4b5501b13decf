"""Figure 5 of Abichequer Sangalli et al. (2022): distance of the character from the desired path.

The figure shows the distances over the grid of speeds and turn rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    DARK,
    INK,
    LIGHT,
    MORE_IS_WORSE,
    SMALL,
    Place,
    add_colour_bar,
    add_panel,
    colours_of_change,
    luminance,
    new_figure,
    nice_levels,
    write,
)
from marey_reports.evaluation.figures.axes import COLUMNS, LONGEST_TITLE, SPEED, TURN_RATE
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject, shorter_labels
from marey_schemas.options.evaluation import Family

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure


FAMILY_TITLES: dict[Family, str] = {
    "circle": "Constant speed",
    "switching": "Switching speed",
    "stopping": "Stops",
    "eights": "Figures of eight",
}
"""Titles of the families whose trials are a grid of speeds and turn rates."""
ENDS = ("#2c7fc4", "#d1495b")
"""Colours of the greatest decrease (blue) and of the greatest increase (red) of the mean offset."""


class _Field(NamedTuple):
    """Mean offset in each trial of one family, by speed (rows) and turn rate (columns); NaN where there is no trial."""

    turn_rates_deg_s: Floats
    speeds_m_s: Floats
    offset_m: Floats


def draw_offsets(subjects: Sequence[Subject], _trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw the mean offsets: a row per family of trials, a column per subject; two subjects get a column of changes.

    More than two subjects share one scale, up to `COLUMNS` side by side.
    """
    families = [family for family in subjects[0].result.options.families if family in FAMILY_TITLES]
    if not families:
        wanted = ", ".join(FAMILY_TITLES)
        raise MotionError(
            f"the figure shows trials of the families {wanted}, but the evaluation has none of them; evaluate with at "
            "least one of these families",
            code="unknown-trial",
        )
    fields = [[_field(subject, family) for subject in subjects] for family in families]
    levels = nice_levels(max(_largest(field) for row in fields for field in row))
    if len(subjects) == 1:
        figure = _draw_one(families, [row[0] for row in fields], levels)
    elif len(subjects) == 2:
        figure = _draw_two(subjects, families, fields, levels)
    else:
        figure = _draw_many(subjects, families, fields, levels)
    return Sketch(figure, {"offsets": _table(subjects, families, fields)}, _caption(subjects, families, fields))


def _field(subject: Subject, family: Family) -> _Field:
    trials = [each for each in subject.result.trials if each.trial.family == family]
    speeds = np.unique([each.trial.speed_m_s for each in trials])
    turn_rates = np.unique([np.round(np.degrees(each.trial.turn_rate_rad_s), 9) for each in trials])
    offset = np.full((len(speeds), len(turn_rates)), np.nan)
    for each in trials:
        row = np.searchsorted(speeds, each.trial.speed_m_s)
        column = np.searchsorted(turn_rates, np.round(np.degrees(each.trial.turn_rate_rad_s), 9))
        value = each.metrics.get("offset_mean")
        offset[row, column] = np.nan if value is None else value
    return _Field(turn_rates, speeds, offset)


def _largest(field: _Field) -> float:
    """Compute the largest absolute value in a field of offsets, or of changes of offsets; 0 if it has no value."""
    return float(np.abs(np.nan_to_num(field.offset_m)).max(initial=0.0))


def _draw_one(families: Sequence[Family], fields: Sequence[_Field], levels: Floats) -> Figure:
    width, height = 3.75, 3.3
    figure = new_figure(0.7 + len(families) * (width + 0.35) + 0.75, height + 1.05)
    drawn = None
    for number, (family, field) in enumerate(zip(families, fields, strict=True)):
        place = Place(0.62 + number * (width + 0.35), 0.58, width, height)
        labels = {"x": TURN_RATE, "y": SPEED if number == 0 else ""}
        drawn = _draw_field(figure, place, field, FAMILY_TITLES[family], labels, levels, MORE_IS_WORSE) or drawn
    if drawn is not None:
        bar = Place(0.62 + len(families) * (width + 0.35) - 0.12, 0.58, 0.14, height)
        add_colour_bar(figure, drawn, bar, "mean offset (m)", levels)
    return figure


def _draw_two(
    subjects: Sequence[Subject], families: Sequence[Family], fields: Sequence[Sequence[_Field]], levels: Floats
) -> Figure:
    width, height, gap = 2.54, 2.3, 0.42
    figure = new_figure(9.6, len(families) * (height + 0.85) + 0.95)
    changes = [_change(*row) for row in fields]
    upward = nice_levels(max(_largest(change) for change in changes))
    both_ways = _both_ways(upward)
    shared, changed = None, None
    for number, (family, row, change) in enumerate(zip(families, fields, changes, strict=True)):
        bottom = 1.3 + (len(families) - 1 - number) * (height + 0.85)
        last = number == len(families) - 1
        titles = [subject.label for subject in subjects] if number == 0 else ["", ""]
        for column, field in enumerate(row):
            place = Place(0.85 + column * (width + gap), bottom, width, height)
            labels = {"x": TURN_RATE if last else "", "y": f"{FAMILY_TITLES[family]}\n{SPEED}" if column == 0 else ""}
            shared = _draw_field(figure, place, field, titles[column], labels, levels, MORE_IS_WORSE) or shared
        place = Place(0.85 + 2 * (width + gap), bottom, width, height)
        labels = {"x": TURN_RATE if last else "", "y": ""}
        title = "change" if number == 0 else ""
        changed = _draw_field(figure, place, change, title, labels, both_ways, colours_of_change(*ENDS)) or changed
    if shared is not None:
        add_colour_bar(figure, shared, Place(0.85, 0.52, 2 * width + gap, 0.12), "mean offset (m)", levels)
    if changed is not None:
        place = Place(0.85 + 2 * (width + gap), 0.52, width, 0.12)
        add_colour_bar(
            figure,
            changed,
            place,
            "change of the mean offset (m); blue: better",
            _both_ways(upward[:: max(1, (len(upward) - 1) // 2)]),
        )
    return figure


def _draw_many(
    subjects: Sequence[Subject], families: Sequence[Family], fields: Sequence[Sequence[_Field]], levels: Floats
) -> Figure:
    """Draw small multiples in rows of up to `COLUMNS` subjects; each row shows one family of trials."""
    width, height, gap, beneath = 1.96, 1.8, 0.26, 0.85
    bands = [
        (family, row, range(first, min(first + COLUMNS, len(subjects))))
        for first in range(0, len(subjects), COLUMNS)
        for family, row in zip(families, fields, strict=True)
    ]
    figure = new_figure(9.6, len(bands) * (height + beneath) + 0.95)
    titles = [subject.label for subject in shorter_labels(subjects, LONGEST_TITLE)]
    shared = None
    for number, (family, row, columns) in enumerate(bands):
        bottom = 1.3 + (len(bands) - 1 - number) * (height + beneath)
        for column, subject in enumerate(columns):
            place = Place(0.85 + column * (width + gap), bottom, width, height)
            labels = {"x": TURN_RATE, "y": f"{FAMILY_TITLES[family]}\n{SPEED}" if column == 0 else ""}
            shared = _draw_field(figure, place, row[subject], titles[subject], labels, levels, MORE_IS_WORSE) or shared
    if shared is not None:
        across = COLUMNS * width + (COLUMNS - 1) * gap
        add_colour_bar(figure, shared, Place(0.85, 0.52, across, 0.12), "mean offset (m)", levels)
    return figure


def _change(before: _Field, after: _Field) -> _Field:
    """Compute after - before on the grid points that both results have."""
    turn_rates = np.intersect1d(before.turn_rates_deg_s, after.turn_rates_deg_s)
    speeds = np.intersect1d(before.speeds_m_s, after.speeds_m_s)
    first, second = (
        field.offset_m[np.ix_(np.isin(field.speeds_m_s, speeds), np.isin(field.turn_rates_deg_s, turn_rates))]
        for field in (before, after)
    )
    return _Field(turn_rates, speeds, second - first)


def _both_ways(upward: Floats) -> Floats:
    """Return values that begin with 0, and before them their negatives."""
    return np.concatenate((-upward[:0:-1], upward))


def _draw_field(
    figure: Figure,
    place: Place,
    field: _Field,
    title: str,
    labels: dict[str, str],
    levels: Floats,
    colours: str | Colormap,
) -> Any:
    """Draw filled contours and one dot per trial, or only dots if the trials span no area.

    Returns the drawn contours or dots, from which the colour scale can be made, or None if there are no trials.
    """
    panel = add_panel(figure, place, title=title, x=labels["x"], y=labels["y"], grid=False)
    known = np.isfinite(field.offset_m)
    if not known.any():
        write(panel, (0.5, 0.5), "no trials", transform=panel.transAxes, ha="center")
        return None
    turn, speed = np.meshgrid(field.turn_rates_deg_s, field.speeds_m_s)
    drawn: Any = None
    if min(field.offset_m.shape) > 1 and np.all(known):
        drawn = panel.contourf(turn, speed, field.offset_m, levels=levels, cmap=colours, extend="neither")
    dots = panel.scatter(
        turn[known], speed[known], c=field.offset_m[known], s=16, cmap=colours, vmin=levels[0], vmax=levels[-1], lw=0.6,
        zorder=4, clip_on=False,
    )  # fmt: skip
    colours_of_dots = dots.cmap(dots.norm(field.offset_m[known]))
    dots.set_edgecolor([_edge_on(colour) for colour in np.asarray(colours_of_dots)])
    _mark_extreme(panel, field, signed=bool(levels[0] < 0.0))
    panel.set_xticks(field.turn_rates_deg_s[:: max(1, len(field.turn_rates_deg_s) // 4)])
    if not labels["y"]:
        panel.tick_params(labelleft=False)
    panel.margins(0.02)
    return drawn or dots


def _edge_on(colour: Floats) -> str:
    """Choose the edge of a dot; a dot that is nearly transparent gets the colour of text on the page."""
    if colour[3] < 0.5:
        return INK
    return DARK if luminance(colour) > 0.3 else LIGHT


def _mark_extreme(panel: Axes, field: _Field, signed: bool) -> None:
    """Write the value that is farthest from zero beside its dot; with `signed`, a positive value gets a plus sign."""
    row, column = np.unravel_index(np.nanargmax(np.abs(field.offset_m)), field.offset_m.shape)
    right, up = column <= field.offset_m.shape[1] // 2, row <= field.offset_m.shape[0] // 2
    panel.annotate(
        f"{field.offset_m[row, column]:{'+' if signed else ''}.2f} m",
        (float(field.turn_rates_deg_s[column]), float(field.speeds_m_s[row])),
        (6 if right else -6, 6 if up else -6),
        textcoords="offset points",
        fontsize=SMALL,
        fontweight="bold",
        color=DARK,
        ha="left" if right else "right",
        va="bottom" if up else "top",
        bbox={"facecolor": LIGHT, "alpha": 0.75, "lw": 0, "pad": 1.5},
        zorder=5,
    )


def _table(
    subjects: Sequence[Subject], families: Sequence[Family], fields: Sequence[Sequence[_Field]]
) -> dict[str, list[object]]:
    names = ("dataset", "family", "speed_m_s", "turn_rate_deg_s", "offset_mean_m")
    table: dict[str, list[object]] = {name: [] for name in names}
    for family, row in zip(families, fields, strict=True):
        for subject, field in zip(subjects, row, strict=True):
            for speed, values in zip(field.speeds_m_s, field.offset_m, strict=True):
                for turn_rate, value in zip(field.turn_rates_deg_s, values, strict=True):
                    for name, entry in zip(
                        names, (subject.label, family, float(speed), float(turn_rate), float(value)), strict=True
                    ):
                        table[name].append(entry)
    return table


def _caption(subjects: Sequence[Subject], families: Sequence[Family], fields: Sequence[Sequence[_Field]]) -> str:
    parts = []
    for family, row in zip(families, fields, strict=True):
        for subject, field in zip(subjects, row, strict=True):
            if np.isfinite(field.offset_m).any():
                name = f"{subject.label}, {FAMILY_TITLES[family].lower()}" if subject.label else FAMILY_TITLES[family]
                low, middle, high = np.nanquantile(field.offset_m, (0.0, 0.5, 1.0))
                parts.append(f"{name}: {low:.2f} to {high:.2f} m, median {middle:.2f} m")
    return "Mean distance from the desired position over each trial; each dot is a trial. " + "; ".join(parts) + "."
