"""Figure 6 of Abichequer Sangalli et al. (2022): density of the data in seconds, over turn rate and speed.

A further figure shows the density over sideways and forward speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.evaluation.result import Coverage
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    LIGHT,
    MORE_IS_DENSER,
    Place,
    add_colour_bar,
    add_panel,
    colours_of_change,
    new_figure,
    nice_ceiling,
    reach,
    square_root_ticks,
    write,
)
from marey_reports.evaluation.figures.axes import COLUMNS, LONGEST_TITLE, SPEED, TURN_RATE
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject, shorter_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FINE = 144  # cells of the drawn map per axis
BANDWIDTH = 0.35  # standard deviation of the smoothing, in cells of the trial grid
NOTICED_M_S = 0.1  # slower than this a body stands, whichever way it sways
DIRECTION_CELL_M_S = 0.25


class _Plane(NamedTuple):
    """Axes of a density map: two quantities with their names, and the area to which the values of the map refer."""

    x: Callable[[Coverage], Floats]
    y: Callable[[Coverage], Floats]
    labels: tuple[str, str]
    names: tuple[str, str]
    cell: Callable[[Coverage], tuple[float, float]]
    cell_label: str
    about: str


def _grid_cell(coverage: Coverage) -> tuple[float, float]:
    return (
        float(np.median(np.diff(coverage.turn_rate_edges_deg_s))),
        float(np.median(np.diff(coverage.speed_edges_m_s))),
    )


SPEEDS = _Plane(
    x=lambda coverage: np.degrees(coverage.turn_rate_rad_s),
    y=lambda coverage: coverage.speed_m_s,
    labels=(TURN_RATE, SPEED),
    names=("turn_rate_deg_s", "speed_m_s"),
    cell=_grid_cell,
    cell_label="seconds of data around one trial",
    about="Brighter areas contain more seconds of data. The frame is the outline of the grid of trials.",
)
DIRECTIONS = _Plane(
    x=lambda coverage: coverage.strafe_m_s,
    y=lambda coverage: coverage.forward_m_s,
    labels=("sideways (m/s, left positive)", "forward (m/s, backward negative)"),
    names=("strafe_m_s", "forward_m_s"),
    cell=lambda _: (DIRECTION_CELL_M_S, DIRECTION_CELL_M_S),
    cell_label="seconds of data per 0.25 x 0.25 m/s",
    about="Velocity relative to the facing direction of the body, which distinguishes backward and sideways motion.",
)


def draw_density(subjects: Sequence[Subject], _trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw the density of the data over turn rate and speed (Figure 6)."""
    return _draw(subjects, SPEEDS)


def draw_directions(subjects: Sequence[Subject], _trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw the density of data over sideways and forward speed."""
    return _draw(subjects, DIRECTIONS)


def _draw(subjects: Sequence[Subject], plane: _Plane) -> Sketch:
    edges = _edges(subjects, plane)
    cell = plane.cell(subjects[0].result.coverage)
    maps = [_seconds(subject, plane, edges, cell) for subject in subjects]
    if len(subjects) > 2:
        figure = _draw_many(subjects, plane, edges, maps)
        return Sketch(figure, {"density": _table(subjects, plane, edges, maps)}, _caption(subjects, plane))
    two = len(subjects) > 1
    width, height, gap = (2.62, 2.7, 0.3) if two else (5.9, 3.9, 0.3)
    figure = new_figure(9.6 if two else 7.6, height + (1.75 if two else 0.75))
    bottom = 1.3 if two else 0.58
    ceiling = nice_ceiling(max(float(each.max()) for each in maps))
    drawn = []
    for number, (subject, each) in enumerate(zip(subjects, maps, strict=True)):
        place = Place(0.68 + number * (width + gap), bottom, width, height)
        x, y = plane.labels
        drawn.append(_draw_map(figure, place, subject, plane, edges, each, ceiling, (x, y if number == 0 else "")))
    if two:
        add_colour_bar(
            figure, drawn[-1], Place(0.68, 0.52, 2 * width + gap, 0.12), plane.cell_label, square_root_ticks(ceiling)
        )
        _draw_change(figure, Place(0.68 + 2 * (width + gap), bottom, width, height), plane, edges, maps)
    else:
        add_colour_bar(
            figure,
            drawn[-1],
            Place(0.68 + width + 0.15, bottom, 0.14, height),
            plane.cell_label,
            square_root_ticks(ceiling),
        )
    return Sketch(figure, {"density": _table(subjects, plane, edges, maps)}, _caption(subjects, plane))


def _draw_many(
    subjects: Sequence[Subject], plane: _Plane, edges: tuple[Floats, Floats], maps: Sequence[Floats]
) -> Figure:
    """Draw small multiples on one scale, up to `COLUMNS` side by side."""
    width, height, gap, beneath = 1.96, 2.0, 0.26, 0.85
    bands = -(-len(subjects) // COLUMNS)
    figure = new_figure(9.6, bands * (height + beneath) + 0.95)
    ceiling = nice_ceiling(max(float(each.max()) for each in maps))
    drawn = []
    for number, (subject, each) in enumerate(zip(shorter_labels(subjects, LONGEST_TITLE), maps, strict=True)):
        band, column = divmod(number, COLUMNS)
        place = Place(0.68 + column * (width + gap), 1.3 + (bands - 1 - band) * (height + beneath), width, height)
        x, y = plane.labels
        drawn.append(_draw_map(figure, place, subject, plane, edges, each, ceiling, (x, y if column == 0 else "")))
    across = COLUMNS * width + (COLUMNS - 1) * gap
    add_colour_bar(figure, drawn[-1], Place(0.68, 0.52, across, 0.12), plane.cell_label, square_root_ticks(ceiling))
    return figure


def _draw_map(
    figure: Figure,
    place: Place,
    subject: Subject,
    plane: _Plane,
    edges: tuple[Floats, Floats],
    seconds: Floats,
    ceiling: float,
    labels: tuple[str, str],
) -> Any:
    """Draw one map; return the drawn image, from which a colour bar can be made."""
    x, y = labels
    panel = add_panel(figure, place, title=subject.label, x=x, y=y, grid=False)
    panel.tick_params(labelleft=bool(y))
    drawn = panel.pcolormesh(*edges, seconds, cmap=MORE_IS_DENSER, norm=_norm(ceiling), rasterized=True, shading="flat")
    _frame(panel, subject.result.coverage, plane)
    if not seconds.any():
        write(panel, (0.5, 0.5), "no clip of one second or more", transform=panel.transAxes, ha="center", color=LIGHT)
    return drawn


def _edges(subjects: Sequence[Subject], plane: _Plane) -> tuple[Floats, Floats]:
    """Compute the edges of the cells of the map along both axes; the map contains all trials and nearly all windows."""
    spans = []
    for axis, values in enumerate((plane.x, plane.y)):
        found = np.concatenate([values(subject.result.coverage) for subject in subjects])
        least = [_least_ranges(subject.result.coverage, plane)[axis] for subject in subjects]
        high = 1.03 * reach(np.maximum(found, 0.0), max(float(each[1]) for each in least))
        low = -1.03 * reach(np.maximum(-found, 0.0), max(-float(each[0]) for each in least))
        if axis == 0:
            low, high = -max(-low, high), max(-low, high)  # left and right alike
        spans.append(np.linspace(low, high, FINE + 1))
    return spans[0], spans[1]


def _least_ranges(coverage: Coverage, plane: _Plane) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the least ranges of x and y that the figure must show in order to contain all trials."""
    fastest = float(coverage.speed_edges_m_s[-1])
    if plane is DIRECTIONS:
        return (-1.0, 1.0), (-1.0, fastest)
    turn = coverage.turn_rate_edges_deg_s
    return (float(turn[0]), float(turn[-1])), (0.0, fastest)


def _seconds(subject: Subject, plane: _Plane, edges: tuple[Floats, Floats], cell: tuple[float, float]) -> Floats:
    """Compute the smoothed seconds of data (FINE, FINE) in the area of size `cell` around each point of the map.

    The size `cell` is given along both axes of `plane`, in the units of the axes.
    """
    from scipy.ndimage import gaussian_filter

    coverage = subject.result.coverage
    counts, _, _ = np.histogram2d(plane.y(coverage), plane.x(coverage), bins=[edges[1], edges[0]])
    fine = np.array([float(edges[1][1] - edges[1][0]), float(edges[0][1] - edges[0][0])])
    sizes = np.array(cell[::-1]) / fine
    smooth = gaussian_filter(counts, BANDWIDTH * sizes, mode="constant", truncate=4.0)
    return np.asarray(smooth * subject.seconds_per_row * sizes.prod(), dtype=np.float64)


def _norm(ceiling: float) -> Any:
    """Make a square-root colour scale from 0 to `ceiling`; it distinguishes small amounts of data from none."""
    from matplotlib.colors import PowerNorm

    return PowerNorm(0.5, vmin=0.0, vmax=ceiling)


def _frame(panel: Axes, coverage: Coverage, plane: _Plane) -> None:
    """Draw the outline of the grid of trials, or the lines of zero forward and sideways speed."""
    look: dict[str, Any] = {"color": LIGHT, "lw": 0.8, "alpha": 0.8}
    if plane is DIRECTIONS:
        panel.axhline(0.0, **look)
        panel.axvline(0.0, **look)
        return
    left, right = coverage.turn_rate_edges_deg_s[[0, -1]]
    low, high = coverage.speed_edges_m_s[[0, -1]]
    panel.plot([left, right, right, left, left], [low, low, high, high, low], ls=(0, (4, 3)), **look)


def _draw_change(
    figure: Figure, place: Place, plane: _Plane, edges: tuple[Floats, Floats], maps: Sequence[Floats]
) -> None:
    from matplotlib.colors import SymLogNorm

    change = maps[1] - maps[0]
    largest = nice_ceiling(float(np.abs(change).max()))
    panel = add_panel(figure, place, title="change", x=plane.labels[0], grid=False)
    panel.tick_params(labelleft=False)
    norm = SymLogNorm(linthresh=0.1 * largest, linscale=1.0, vmin=-largest, vmax=largest)
    colours = colours_of_change("#d9820f", "#8f6fd0")  # orange and violet
    drawn = panel.pcolormesh(*edges, change, cmap=colours, norm=norm, rasterized=True, shading="flat")
    bar = add_colour_bar(figure, drawn, Place(place.left, 0.52, place.width, 0.12), "seconds more (violet) or fewer")
    bar.set_xticks([-largest, -0.1 * largest, 0.1 * largest, largest])
    bar.set_xticklabels([f"{value:+g}" for value in (-largest, -0.1 * largest, 0.1 * largest, largest)])
    bar.minorticks_off()


def _table(
    subjects: Sequence[Subject], plane: _Plane, edges: tuple[Floats, Floats], maps: Sequence[Floats]
) -> dict[str, object]:
    x, y = (0.5 * (each[:-1] + each[1:]) for each in edges)
    table: dict[str, object] = {plane.names[0]: np.tile(x, len(y)), plane.names[1]: np.repeat(y, len(x))}
    for subject, each in zip(subjects, maps, strict=True):
        table[subject.column("seconds_s")] = each.ravel()
    return table


def _caption(subjects: Sequence[Subject], plane: _Plane) -> str:
    parts = []
    for subject in subjects:
        coverage = subject.result.coverage
        held = len(coverage.clip) * subject.seconds_per_row
        if plane is SPEEDS:
            parts.append(
                f"{subject.prefix}{held:.0f} s of data, {100 * coverage.index:.0f} % of the trials have enough of it, "
                f"left-right symmetry {coverage.symmetry:.2f}."
            )
        else:
            strafe, forward = np.abs(coverage.strafe_m_s), np.abs(coverage.forward_m_s)
            backward = float(np.mean(coverage.forward_m_s < -NOTICED_M_S)) if held else 0.0
            sideways = float(np.mean((strafe > forward) & (strafe > NOTICED_M_S))) if held else 0.0
            parts.append(
                f"{subject.prefix}{100 * backward:.0f} % of the time backward, {100 * sideways:.0f} % mainly sideways."
            )
    return f"{plane.about} {' '.join(parts)}"
