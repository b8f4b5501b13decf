"""Legends of figures never cover data, and many clips are distinguished by their names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from tests.support.compared_runs import a_curve, a_run, compared_of
from tests.support.drawn_evaluations import (
    DRAWN_EVALUATIONS,
    LITTLE,
    NAMING,
    changed,
    drawn_both,
    drawn_of_little,
    usual,
)
from tests.support.drawn_figures import covered_by_legends, cut_off
from tests.support.drawn_models import figures_of_walks
from tests.support.evaluation_results import synthetic_result
from tests.support.present import present
from tests.support.studying import analysis_of
from tests.support.tiers import is_soak

from marey_reports.comparisons import page as runs_page
from marey_reports.comparisons.subjects import ComparedSubject
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.paper import COLOURS, add_keys, new_figure
from marey_reports.evaluation.figures import draw_figure, draw_shared_figures, drawable
from marey_reports.perception.study_page import draw_groups

pytestmark = DRAWN_EVALUATIONS

MANY = 130


def assert_free(figures: Mapping[str, DrawnFigure]) -> None:
    for name, drawn in figures.items():
        assert covered_by_legends(drawn.sketch.figure) == [], name


def test_the_check_finds_a_legend_over_a_line() -> None:
    figure = new_figure(4.0, 3.0)
    axes = figure.add_subplot()
    axes.plot([0.0, 1.0], [0.0, 1.0], label="a line")
    add_keys(axes, loc="upper right")
    assert covered_by_legends(figure) != []
    present(axes.get_legend()).remove()
    add_keys(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    assert covered_by_legends(figure) == []


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("name", LITTLE)
def test_no_legend_of_an_odd_evaluation_covers_data(name: str) -> None:
    assert_free(drawn_of_little(name))


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("count", [1, 6, 7, MANY])
def test_no_legend_covers_data_with_any_number_of_clips(count: int) -> None:
    result = synthetic_result(clips=count, unused=0, frames=120)
    figures = {name: draw_figure(name, result) for name in (drawable(result) if is_soak() else NAMING)}
    assert_free(figures)
    assert cut_off(figures["points"].sketch.figure) == []


@pytest.mark.soak
def test_no_legend_covers_data_in_a_comparison() -> None:
    assert_free(drawn_both())
    assert_free(draw_shared_figures([usual(), changed(), usual()], ["a", "b", "c"]))


@pytest.mark.soak
def test_no_legend_of_other_reports_covers_data() -> None:
    assert_free(figures_of_walks())
    analysis = analysis_of(8)
    assert analysis.order is not None
    assert covered_by_legends(draw_groups(analysis.order, [f"motion {n}" for n in range(8)]).figure) == []
    runs = [a_run(n, {"rate": n // 2, "size": n % 2}, {"loss": 1.0 + n}, seed=n) for n in range(16)]
    curves = {n: {"loss": a_curve([3.0, 2.0, 1.0 + n], 10)} for n in range(16)}
    subject = ComparedSubject(compared_of(runs, curves), log=False)
    drawn = list(runs_page._figures(subject, subject.fields, None, None))
    assert_free({figure.name: figure for figure in drawn})


def titles_of(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes]


def coloured(figure: Figure) -> list[set[Any]]:
    """Return the colours of the points in each panel, without grey."""
    return [
        {tuple(row) for one in axes.collections for row in np.asarray(one.get_facecolor())[:, :3].tolist()}
        for axes in figure.axes
    ]


def test_few_clips_have_colours_and_a_legend_and_more_have_their_names_above_a_panel_each() -> None:
    few = draw_figure("points", synthetic_result(clips=len(COLOURS), unused=0)).sketch.figure
    assert len(few.axes) == 1
    assert few.axes[0].get_legend() is not None

    result = synthetic_result(clips=len(COLOURS) + 3, unused=0)
    many = draw_figure("points", result).sketch.figure
    assert sorted(titles_of(many)) == sorted(clip.name for clip in result.clips)
    assert all(axes.get_legend() is None for axes in many.axes)
    assert all(len(colours) <= 2 for colours in coloured(many)), "one colour, and grey"


def test_of_very_many_clips_those_with_least_data_share_a_panel() -> None:
    result = synthetic_result(clips=MANY, unused=0, frames=120)
    *names, rest = titles_of(draw_figure("points", result).sketch.figure)
    assert len(names) == 20
    assert rest == f"{len(np.unique(result.coverage.clip)) - 20} other clips"
