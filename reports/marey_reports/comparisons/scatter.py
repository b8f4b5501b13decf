"""Chart of a field over a parameter: each run as a dot, and means of replicates with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from marey_reports.comparisons.axes import add_chart, axis_title, beside, set_logarithmic, spread, widened
from marey_reports.comparisons.subjects import (
    LARGEST,
    SMALLEST,
    ComparedSubject,
    Point,
    interval_words,
    missing_words,
    written,
)
from marey_reports.drawing.drawn import Sketch, Tables
from marey_reports.drawing.paper import COLOURS, MARKERS, QUIET, Place, add_keys, new_figure, plain
from marey_schemas.queue.comparisons import ComparedColumn, number_of
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE = 100.0
"""Least ratio of the largest to the smallest value of a parameter for a logarithmic axis."""
MOST_NAMES = 12
"""Greatest number of different texts on the horizontal axis."""
MOST_NUMBERED = 24
"""Greatest number of means in a chart for which the number of runs is written beside each mean."""
_APART, _BESIDE = 0.125, 0.083
"""Distance between neighbouring groups, and distance of runs from their mean, in inches."""
_MOST_SIGNS = 60
"""Greatest number of characters of all texts along the axis together; above this number, the texts are turned."""


class _Across(NamedTuple):
    """Place of each setting on the horizontal axis.

    If the parameter has texts as values, `names` lists the texts at the places 0, 1, ...; otherwise, `names` is empty.
    """

    places: dict[int, float]
    names: tuple[str, ...]
    log: bool

    @property
    def turned(self) -> bool:
        """Whether the texts are turned, because they are long."""
        return sum(map(len, self.names)) > _MOST_SIGNS


def draw_scatter(subject: ComparedSubject, column: ComparedColumn, parameter: ComparedColumn) -> Sketch | None:
    """Draw a field over a parameter; return None if there are no numbers, or too many different texts.

    Means are not joined by lines, because nothing is known about values between them. If exactly one further parameter
    differs, its values have different colours.
    """
    across = _across(subject, parameter)
    points = [one for one in subject.points(column.name) if across is not None and one.setting in across.places]
    if across is None or not points:
        return None
    numbers = [number for one in points for number in one.numbers]
    log = subject.is_log(numbers)
    further = _further(subject, parameter, points)
    width = 5.9 if len(further) > 1 else 8.2
    bottom = 1.25 if across.turned else 0.65
    figure = new_figure(9.6, bottom + 3.35)
    panel = add_chart(
        figure,
        Place(0.95, bottom, width, 2.85),
        title=f"{axis_title(column.name)} by {axis_title(parameter.name)}",
        x=axis_title(parameter.name, log=across.log),
        y=axis_title(column.name, log=log),
    )
    low, high = min(numbers), max(numbers)
    if not log:
        low, high = widened(low, high, [one.summary for one in points])
    panel.set_ylim(*spread(low, high, log=log))
    _set_across(panel, across)
    if log:
        set_logarithmic(panel.yaxis)
    for number, (name, some) in enumerate(further.items()):
        _draw_points(panel, some, across, number, name, shift=(number - (len(further) - 1) / 2.0) * _APART)
    if len(further) > 1:
        add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.03))
    return Sketch(figure, _tables(subject, points, across), _caption(subject, column, parameter, points))


def _across(subject: ComparedSubject, parameter: ComparedColumn) -> _Across | None:
    cells = {place: subject.first_run(place).cell(parameter) for place in range(len(subject.comparison.settings))}
    if parameter.numeric:
        numbers = {place: number_of(cell) for place, cell in cells.items()}
        places = {place: one for place, one in numbers.items() if one is not None and abs(one) <= LARGEST}
        known = places.values()
        log = bool(places) and min(known) >= SMALLEST and max(known) / min(known) >= WIDE
        return _Across(places, (), log) if places else None
    names = [written(parameter, subject.first_run(place)) for place in cells]
    order = list(dict.fromkeys(names))
    if len(order) > MOST_NAMES:
        return None
    return _Across({place: float(order.index(name)) for place, name in zip(cells, names, strict=True)},
                   tuple(order), log=False)  # fmt: skip


def _set_across(panel: Axes, across: _Across) -> None:
    known = across.places.values()
    if across.names:
        panel.set_xlim(-0.6, len(across.names) - 0.4)
        panel.set_xticks(range(len(across.names)), [plain(name) for name in across.names], parse_math=False,
                         rotation=20 if across.turned else 0, ha="right" if across.turned else "center")  # fmt: skip
        return
    panel.set_xlim(*spread(min(known), max(known), log=across.log))
    if across.log:
        set_logarithmic(panel.xaxis)


def _further(subject: ComparedSubject, parameter: ComparedColumn, points: Sequence[Point]) -> dict[str, list[Point]]:
    """Group settings by their value in the only other column that differs.

    All settings are in one group if no other column differs, if several differ, or if the column has too many
    values.
    """
    others = [column for column in subject.varied if column != parameter]
    groups: dict[str, list[Point]] = {}
    if len(others) == 1:
        for one in sorted(points, key=lambda one: number_of(subject.first_run(one.setting).cell(others[0])) or 0.0):
            name = f"{others[0].name} = {written(others[0], subject.first_run(one.setting))}"
            groups.setdefault(name, []).append(one)
    return groups if 1 < len(groups) <= len(COLOURS) else {"": list(points)}


def _draw_points(panel: Axes, points: list[Point], across: _Across, number: int, name: str, *, shift: float) -> None:
    """Draw settings; `shift` moves them to the right, in inches, so that groups lie side by side."""
    at, aside = (beside(panel, panel.transData, inches) for inches in (shift, shift - _BESIDE))
    colour, limits = COLOURS[number], (panel.get_xlim(), panel.get_ylim())
    runs = [(across.places[one.setting], value) for one in points if one.summary.n > 1 for value in one.numbers]
    if runs:
        panel.plot(*zip(*runs, strict=True), ls="", marker="o", ms=3.4, mew=0, color=colour, alpha=0.5, transform=aside)
    xs, means = [across.places[one.setting] for one in points], [one.summary.mean for one in points]
    ends = [
        (x, one.summary.low, one.summary.high) for x, one in zip(xs, points, strict=True) if one.summary.low is not None
    ]
    if ends:
        panel.vlines(*zip(*ends, strict=True), color=colour, lw=1.4, transform=at)
    size = 6.5 if len(points) <= MOST_NUMBERED else 4.5
    label = f"{plain(name)} (n = {_span([one.summary.n for one in points])})" if name else None
    panel.plot(xs, means, ls="", marker=MARKERS[number], ms=size, color=colour, zorder=3, transform=at, label=label)
    if not name and len(points) <= MOST_NUMBERED:
        for x, one in zip(xs, points, strict=True):
            panel.annotate(f"n = {one.summary.n}", (x, one.summary.mean), xytext=(7, 0), textcoords="offset points",
                           fontsize=7, color=QUIET, va="center")  # fmt: skip
    panel.set(xlim=limits[0], ylim=limits[1])


def _span(counts: Sequence[int]) -> str:
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _caption(
    subject: ComparedSubject, column: ComparedColumn, parameter: ComparedColumn, points: Sequence[Point]
) -> str:
    parts = [f"{column.name} by {parameter.name}"]
    if any(one.summary.n > 1 for one in points):
        parts.append("small dots are runs with different seeds, and large marks are the means of n runs")
    if any(one.summary.low is not None for one in points):
        parts.append(f"vertical lines are {interval_words()}")
    others = [one.name for one in subject.varied if one != parameter]
    if len(others) > 1:
        parts.append(f"{counted(len(others), 'other value')} differ, too: {', '.join(others[:5])}")
    if len(points) > MOST_NUMBERED:
        parts.append(f"n is {_span([one.summary.n for one in points])}")
    return f"{'; '.join([*parts, *missing_words(subject.left_out(column.name))])}."


def _tables(subject: ComparedSubject, points: Sequence[Point], across: _Across) -> Tables:
    rows = [(one, number) for one in points for number in one.numbers]
    return {
        "runs": {
            "setting": [subject.labels[one.setting] for one, _ in rows],
            "parameter": [
                across.names[int(across.places[one.setting])] if across.names else across.places[one.setting]
                for one, _ in rows
            ],
            "field": [number for _, number in rows],
        }
    }
