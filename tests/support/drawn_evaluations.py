"""Figures of synthetic evaluations for tests. Each is drawn once per process, to be read only.

Drawing all figures of an evaluation takes seconds, so test files that do this are in the group `DRAWN_EVALUATIONS`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_results import SMALL, Making, evaluated, some_coverage, synthetic_result, wandering
from tests.support.report_pages import HOSTILE
from tests.support.tiers import is_soak

from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.matching.database import DatabaseClip
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.evaluation.figures import COVERAGE_FIGURES, FIGURES, USE_FIGURES, draw_figure, draw_figures
from marey_schemas.options.evaluation import EvaluationOptions

DRAWN_EVALUATIONS = pytest.mark.xdist_group("evaluations that are drawn")


@functools.cache
def usual() -> EvaluationResult:
    """Return an evaluation whose clips turn right more than left, so that data is missing."""
    return synthetic_result(seed=4, turns_deg_s=(-90.0, 20.0))


@functools.cache
def changed() -> EvaluationResult:
    """Return an evaluation to compare with the usual one: one clip is new, three are missing, errors are smaller."""
    after = synthetic_result(seed=4, clips=10, turns_deg_s=(-90.0, 20.0), sway_m=0.05)
    return replace(after, clips=(replace(after.clips[0], uid="new@1", name="newcomer"), *after.clips[1:]))


@functools.cache
def figure_of(name: str, trial: str | None = None) -> DrawnFigure:
    """Return one figure of the usual evaluation."""
    return draw_figure(name, usual(), trial=trial)


@functools.cache
def drawn_both() -> Mapping[str, DrawnFigure]:
    """Return the figures that compare the evaluations `usual()` and `changed()`, by name."""
    return MappingProxyType(draw_figures(usual(), other=changed(), labels=("old", "new")))


def tiny(
    clips: tuple[DatabaseClip, ...], options: EvaluationOptions = SMALL, seed: int = 0, covered: bool = True
) -> EvaluationResult:
    """Return an evaluation of these clips. Its coverage contains windows of the clips if `covered`, else none."""
    random = np.random.default_rng(seed)
    trials = suite_trials(options)
    records = tuple(wandering(trial, clips, 0.1, random) for trial in trials)
    how = Making(turns_deg_s=(-5.0, 5.0))
    coverage = some_coverage(options, clips if covered else (), how, random)
    return evaluated(options, clips, trials, records, coverage)


def _without_transitions() -> EvaluationResult:
    result = synthetic_result(clips=1, unused=0)
    records = tuple(
        replace(
            record,
            status=np.zeros_like(record.status),
            rows=np.minimum(np.arange(len(record.rows)), result.clips[0].stop - 1).astype(np.int32),
        )
        for record in result.records
    )
    trials = [each.trial for each in result.trials]
    made = evaluated(result.options, result.clips, trials, records, result.coverage)
    return replace(made, switches=np.zeros((0, 3), dtype=np.int64))


def _of(**options: Any) -> Callable[[], EvaluationResult]:
    return lambda: synthetic_result(EvaluationOptions(**options))


def _unmeasured(every: int) -> EvaluationResult:
    """Return the usual evaluation, but without measured values in every n-th trial (n = `every`)."""
    trials = tuple(
        each if index % every else replace(each, metrics=dict.fromkeys(each.metrics))
        for index, each in enumerate(usual().trials)
    )
    return replace(usual(), trials=trials, suite=usual().suite if every > 1 else {})


DEFAULT_FIGURES = tuple(name for name, kind in FIGURES.items() if {"circle", "switching"} & set(kind.families))
"""Names of the figures of an evaluation with the default families of trials."""

LITTLE: dict[str, Callable[[], EvaluationResult]] = {
    "one clip": lambda: tiny((DatabaseClip("only", "only", "", 0, 900),)),
    "clips of one frame": lambda: tiny(tuple(DatabaseClip(f"c{i}", f"c{i}", "", i, i + 1) for i in range(3))),
    "no transitions": _without_transitions,
    "no windows": lambda: tiny((DatabaseClip("short", "short", "", 0, 30),), covered=False),
    "one trial": _of(speeds_m_s=(1.5,), turn_rates_deg_s=(0.0,), duration_s=3.0, families=("circle",)),
    "one speed": _of(speeds_m_s=(1.5,), turn_rates_deg_s=(-50.0, 50.0), duration_s=6.0),
    "no tick moved": lambda: replace(
        usual(), records=tuple(replace(one, positions=0.0 * one.positions) for one in usual().records)
    ),
    "unknown numbers": lambda: _unmeasured(2),
    "costs unknown": lambda: replace(
        usual(), records=tuple(replace(one, pose_cost=np.nan * one.pose_cost) for one in usual().records)
    ),
    "no records": lambda: replace(usual(), records=(), notes=()),
    "nothing used": lambda: replace(
        usual(),
        usage=tuple(replace(one, ticks=0, share=0.0, popularity=0 * one.popularity) for one in usual().usage),
        switches=np.zeros((0, 3), dtype=np.int64),
    ),
    "no trials": lambda: replace(usual(), trials=(), records=(), suite={}),
    "no numbers": lambda: _unmeasured(1),
}
"""Evaluations that have little to draw."""

SHOWS = {
    "one clip": ("points", *USE_FIGURES),
    "clips of one frame": ("points", *USE_FIGURES),
    "no transitions": ("transition-cost", *USE_FIGURES),
    "no windows": COVERAGE_FIGURES,
    "one trial": ("scenario-circle", "offsets", "errors", *COVERAGE_FIGURES),
    "one speed": ("offsets", *COVERAGE_FIGURES),
    "no tick moved": ("scenario-circle", "scenario-switching", "transition-cost", "errors"),
    "costs unknown": ("transition-cost",),
    "unknown numbers": ("offsets", "usage", "scenario-circle", "scenario-switching", "transition-cost", "errors"),
    "no numbers": ("offsets", "usage"),
    "no records": ("usage", "frame-use"),
    "nothing used": USE_FIGURES,
    "no trials": ("offsets", *USE_FIGURES),
}
"""For each evaluation that has little to draw: the names of the figures that show the data in question."""

NAMING = ("points", *USE_FIGURES)
"""Figures that contain names of clips."""


@functools.cache
def little(name: str) -> EvaluationResult:
    """Return an evaluation that has little to draw."""
    return LITTLE[name]()


@functools.cache
def drawn_of_little(name: str) -> Mapping[str, DrawnFigure]:
    """Return the figures of `little(name)` that show what is little; in the tier `soak`, all its figures."""
    if is_soak():
        return draw_figures(little(name))
    return {figure: draw_figure(figure, little(name)) for figure in SHOWS[name]}


@functools.cache
def drawn_beside_little(name: str) -> Mapping[str, DrawnFigure]:
    """Return figures that compare `little(name)` with the usual evaluation, selected as in `drawn_of_little`."""
    if is_soak():
        return draw_figures(little(name), other=usual())
    return {figure: draw_figure(figure, little(name), other=usual()) for figure in SHOWS[name]}


HOSTILE_NAMES = (
    *HOSTILE,
    r"cost $5 and \frac{1}{0} ^_ {",
    "<b>bold</b> & more",
    "line\nbreak \x00\x1b",
    "x" * 5000,
    "",
)


@functools.cache
def hostile() -> EvaluationResult:
    """Return an evaluation of clips whose names are markup, formulas, unprintable characters, very long or empty."""
    return synthetic_result(names=HOSTILE_NAMES, unused=10, seed=2)


@functools.cache
def drawn_hostile() -> Mapping[str, DrawnFigure]:
    """Return the figures of `hostile()` that contain names of clips; in the tier `soak`, all its figures."""
    return {name: draw_figure(name, hostile()) for name in (DEFAULT_FIGURES if is_soak() else NAMING)}
