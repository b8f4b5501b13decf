"""Report of a study: order and groups of the motions, the table of perceived differences, and the fitted metrics.

These are the contents of figures 3, 4 and 5 of Pražák et al.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from marey_motion.perception.metric import JOINT_CLASSES
from marey_motion.perception.ordering import MotionOrder
from marey_motion.perception.study_analysis import FittedMetric, StudyAnalysis
from marey_motion.version import code_version
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Content, element, joined
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.paper import (
    COLOURS,
    SMALL,
    Place,
    add_colour_bar,
    add_keys,
    add_panel,
    labels_of,
    new_figure,
    plain,
)
from marey_reports.drawing.tables import Cell, facts, folded, number, share, table
from marey_reports.perception.page import FORMULA
from marey_schemas.documents.metrics import MEASUREMENTS
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BOUNDARY = "#009e73"
_LEFT, _BOTTOM, _TOP, _PER_MOTION = 1.4, 1.35, 0.45, 0.26
_LEAST_SIDE = 3.2


def render_study_report(
    analysis: StudyAnalysis,
    names: Sequence[str],
    refusals: Sequence[str] = (),
    *,
    title: str,
    inputs: Sequence[ReportInput] = (),
) -> str:
    """Render the report of a study as an HTML document.

    Parameters
    ----------
    analysis : the analysis
    names : name of each motion, for people: its label in the study, or the name of the clip
    refusals : further reasons why a part of the analysis could not be computed
    title : heading of the page
    inputs : the analysed revision of the study, for the head
    """
    figures: dict[str, DrawnFigure] = {}
    if analysis.order is not None:
        figures["groups"] = DrawnFigure(
            draw_groups(analysis.order, names), "groups", "3", "Order and groups of the motions"
        )
    figures["table"] = DrawnFigure(draw_table(analysis, names), "table", "4", "Perceived differences")
    sections = [
        Section("groups", "Order and groups", joined([shown(figures, "groups"), _order_text(analysis)])),
        Section("differences", "Differences", joined([shown(figures, "table"), _table_text(analysis, names)])),
        Section("fits", "Fitted metrics", _fits(analysis, refusals)),
        Section("reading", "How to read this", _reading()),
    ]
    head = ReportHead("Study of perceived differences", title, code_version(), inputs)
    return page(head, _summary(analysis), sections)


# -- figures ----------------------------------------------------------------------------------------------------------


def draw_groups(order: MotionOrder, names: Sequence[str]) -> Sketch:
    """Draw the membership of each motion in both groups, along the order of the first component.

    The figure follows figure 3 of Pražák et al.
    """
    count = len(names)
    side = max(_LEAST_SIDE, _PER_MOTION * count)
    figure = new_figure(_LEFT + side + 0.4, _BOTTOM + 2.4 + _TOP)
    panel = add_panel(figure, Place(_LEFT, _BOTTOM, side, 2.4), y="membership")
    places, second = np.arange(count), order.membership[order.order]
    for values, label, colour, marker in (
        (1.0 - second, "group 1", COLOURS[0], "o"), (second, "group 2", COLOURS[1], "s"),
    ):  # fmt: skip
        panel.plot(places, values, color=colour, marker=marker, ms=4, lw=1.4, label=label)
    boundary = _boundary(order)
    if boundary is not None:
        panel.axvline(boundary, color=_BOUNDARY, lw=1.4, label="boundary")
    panel.set_ylim(0.0, 1.0)
    panel.set_xlim(-0.6, count - 0.4)
    _name_along(panel, [names[each] for each in order.order])
    add_keys(panel, loc="upper left", bbox_to_anchor=(-0.02, 1.19), ncols=3)
    caption = (
        "Membership of each motion in the two groups of k-means, in the order of the first principal component. Near "
        "0.5, a motion belongs to neither group clearly."
    )
    columns = {
        "motion": [names[each] for each in order.order],
        "projection": order.projections[order.order],
        "group": order.groups[order.order] + 1,
        "membership_in_group_2": second,
    }
    return Sketch(figure, {"groups": columns}, caption)


def draw_table(analysis: StudyAnalysis, names: Sequence[str]) -> Sketch:
    """Draw the table of perceived differences in the order of the first component (figure 4 of Pražák et al.)."""
    count, order = len(names), analysis.order
    places = np.arange(count) if order is None else order.order
    side = max(_LEAST_SIDE, _PER_MOTION * count)
    figure = new_figure(_LEFT + side + 1.1, _BOTTOM + side + _TOP)
    panel = add_panel(figure, Place(_LEFT, _BOTTOM, side, side), grid=False)
    ordered = [names[each] for each in places.tolist()]
    values = np.ma.masked_invalid(analysis.table.differences[np.ix_(places, places)])
    panel.set_facecolor("#9aa7b8")  # of pairs that were never shown together
    image = panel.imshow(values, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    boundary = None if order is None else _boundary(order)
    if boundary is not None:
        for draw in (panel.axvline, panel.axhline):
            draw(boundary, color=_BOUNDARY, lw=1.6, ls="--")
    _name_along(panel, ordered)
    panel.set_yticks(range(count), _labels(ordered), fontsize=SMALL, parse_math=False)
    add_colour_bar(figure, image, Place(_LEFT + side + 0.15, _BOTTOM, 0.12, side), "perceived difference")
    caption = (
        "Perceived difference of each pair: the share of the trials with both motions in which another pair was "
        "chosen. Black: always chosen; white: never; blue-grey: never shown together. The dashed line is the boundary "
        "of the groups."
    )
    columns = {"motion": ordered} | {
        f"difference_to_{index + 1}": [None if np.ma.is_masked(one) else float(one) for one in values[:, index]]
        for index in range(count)
    }
    return Sketch(figure, {"differences": columns}, caption)


def _boundary(order: MotionOrder) -> float | None:
    """Return the position in the order that separates the two groups, or None if no position separates them."""
    along = order.groups[order.order]
    changes = np.flatnonzero(np.diff(along))
    return float(changes[0]) + 0.5 if len(changes) == 1 else None


def _name_along(panel: Axes, names: Sequence[str]) -> None:
    panel.set_xticks(range(len(names)), _labels(names), rotation=90, fontsize=SMALL, parse_math=False)


def _labels(names: Sequence[str]) -> list[str]:
    """Return names that are short enough for the space beside and below a panel."""
    return [plain(name) for name in labels_of(names, 16)]


# -- texts and tables -------------------------------------------------------------------------------------------------


def _summary(analysis: StudyAnalysis) -> Content:
    held = 1.0 - analysis.violated / analysis.checked if analysis.checked else None
    best = analysis.fits[0] if analysis.fits else None
    ceiling = analysis.table.noise_ceiling
    tiles = [
        ("participants", f"{analysis.participants:,}", f"{len(analysis.judgements.shown):,} answered trials"),
        ("motions", f"{analysis.judgements.motion_count:,}", f"{len(analysis.missing):,} pairs never shown together"),
        ("noise", number(ceiling, 3).written, "standard error of the differences by chance"),
        (
            "triangle inequality",
            "–" if held is None else share(held).written,
            f"{analysis.violated:,} of {analysis.checked:,} violated",
        ),
    ]
    if best is not None:
        r2 = best.quality.r2
        explains = f"; it explains {share(max(r2, 0.0)).written} of the variance" if np.isfinite(r2) else ""
        note = f"root mean square error, {_shaping(best)}{explains}"
        tiles.append(("best fit", number(best.quality.rmse, 3).written, note))
    return facts(tiles)


def _order_text(analysis: StudyAnalysis) -> Content:
    if analysis.order is None:
        return element("p", next(text for text in analysis.refusals if text.startswith("order")))
    sizes = np.bincount(analysis.order.groups, minlength=2)
    mixed = "" if _boundary(analysis.order) is not None else " The first component does not separate the groups."
    return element(
        "p", f"The groups have {counted(int(sizes[0]), 'motion')} and {counted(int(sizes[1]), 'motion')}.{mixed}"
    )


def _table_text(analysis: StudyAnalysis, names: Sequence[str]) -> Content:
    differences = analysis.table.differences
    pairs = [
        (names[i], names[j], number(float(differences[i, j]), 3), number(int(analysis.table.shown[i, j]), 0))
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    heads = ("motion", "motion", "difference", "shown together")
    return folded("All pairs", table("Perceived differences of all pairs", heads, pairs, numbers=(2, 3)))


def _shaping(fit: FittedMetric) -> str:
    return fit.parts[0].component.shaping


def _fits(analysis: StudyAnalysis, refusals: Sequence[str]) -> Content:
    fitting = [text for text in analysis.refusals if not text.startswith("order")]
    refused = [element("p", text) for text in (*refusals, *fitting)]
    if not analysis.fits:
        return joined([*refused, element("p", "No metric was fitted.")])
    return joined([_weights_table(analysis), _shares_table(analysis), *refused])


def _weights_table(analysis: StudyAnalysis) -> Content:
    heads = (
        "measurement and shaping",
        "error",
        "R²",
        "left out",
        "constant",
        "N",
        *(name.replace("_", " ") for name in JOINT_CLASSES),
    )
    rows: list[Sequence[Cell]] = []
    measurements = list(dict.fromkeys(part.component.measurement for fit in analysis.fits for part in fit.parts))
    for measurement in measurements:
        for fit in sorted(analysis.fits, key=_shaping):
            rows += [_weights_row(analysis, fit, at) for at, part in enumerate(fit.parts) if
                     part.component.measurement == measurement]  # fmt: skip
    caption = "Weights of the joint classes for each measurement and shaping, as in figure 5 of Pražák et al. (2009)"
    return table(caption, heads, rows, numbers=range(1, len(heads)))


def _weights_row(analysis: StudyAnalysis, fit: FittedMetric, at: int) -> Sequence[Cell]:
    part = fit.parts[at]
    component, total = part.component, sum(part.component.weights.values())
    name = f"{component.measurement}, {component.shaping}"
    if component.shaping == "power":
        name += f" {component.exponent:.2f}"
    left_out = None
    if part.left_out is not None:
        ones, others = np.triu_indices(analysis.judgements.motion_count, 1)
        residuals = part.left_out - analysis.table.differences[ones, others]
        left_out = float(np.sqrt(np.nanmean(residuals**2)))
    weights = [number(component.weights[each] / total, 3) if each in component.weights else number(None)
               for each in JOINT_CLASSES]  # fmt: skip
    return (
        name, number(part.quality.rmse, 3), number(part.quality.r2, 2), number(left_out, 3),
        number(component.constant, 3), number(component.norm, 3), *weights,
    )  # fmt: skip


def _shares_table(analysis: StudyAnalysis) -> Content:
    rows: list[Sequence[Cell]] = []
    for fit in analysis.fits:
        shares = dict(zip((part.component.measurement for part in fit.parts), fit.metric.shares, strict=True))
        cells = [number(shares.get(each), 3) for each in MEASUREMENTS]
        quality = fit.quality
        rows.append((_shaping(fit), *cells, number(quality.rmse, 3), number(quality.r2, 2),
                     number(quality.spearman, 2), number(fit.left_out_rmse, 3)))  # fmt: skip
    heads = ("shaping", "angles", "positions", "velocities", "error", "R²", "Spearman", "left out")
    return table("Metrics of all measurements, best first: shares and agreement", heads, rows, numbers=range(1, 8))


def _reading() -> Content:
    texts = (
        FORMULA,
        "A difference is a share of trials, between 0 and 1; a trial shows six pairs, and one of them is chosen, so "
        "the mean difference is five sixths.",
        "The noise is the standard error of the differences that follows from the number of trials. A fit with a "
        "smaller error describes the noise. The noise contains chance alone, and not how much other people would "
        "differ from these participants. It is not known (–) if too few answers repeat a pair.",
        "Left out: the error for motions that were left out of the fit, one at a time. If it is much greater than the "
        "error, the weights do not carry over to other motions.",
        "The groups are those of k-means with two groups; every set of motions can be divided in two. Look at the "
        "memberships before you name the groups.",
    )
    return joined([element("p", text) for text in texts])
