"""Report of a study: its contents, also without an order of the motions, and without a fitted metric."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.perception.fitting import PairDifferences
from marey_motion.perception.judging import simulate_judgements
from marey_motion.perception.study_analysis import StudyAnalysis, analyse_study
from marey_reports.perception.study_page import render_study_report
from marey_schemas.documents.metrics import classes_of

MOTIONS = 8
NAMES = [f"walk <{number}>" for number in range(MOTIONS)]


def differences() -> Floats:
    """Return differences of two groups of motions, of four each."""
    group = np.arange(MOTIONS) // 4
    table = 0.5 + 0.4 * (group[:, None] != group)
    return np.asarray(np.where(np.eye(MOTIONS, dtype=bool), 0.0, table))


@cache
def analysed(*, with_poses: bool) -> StudyAnalysis:
    judgements = simulate_judgements(differences(), 6, seed=1, noise=0.1)
    ones, others = np.triu_indices(MOTIONS, 1)
    rng, pairs = np.random.default_rng(2), np.stack((ones, others), axis=1).astype(np.int64)
    frames = tuple(
        np.asarray(rng.gamma(2.0, 0.04, (30, 8)) + 0.2 * (ones[at] // 4 != others[at] // 4)) for at in range(len(ones))
    )
    measured = [PairDifferences("positions", classes_of("positions"), pairs, frames)] if with_poses else []
    return analyse_study(judgements, measured, name="walks", draws=20, seed=3)


def test_a_report_shows_order_table_and_metrics_and_escapes_names() -> None:
    analysis = analysed(with_poses=True)
    page = render_study_report(analysis, NAMES, title="Which <walks>?")
    assert "Which &lt;walks&gt;?" in page
    assert "<walk" not in page.lower().replace("walk &lt;", "")
    assert set(re.findall(r"positions, (\w+)", page)) == {"euclid", "manhattan", "power", "sigmoid"}
    best = analysis.fits[0].quality
    assert best.r2 > 0.5, "the poses explain the differences"
    assert f"it explains {100 * best.r2:.1f} % of the variance" in page
    assert "The groups have 4 motions and 4 motions." in page
    assert "upper arm" in page
    assert "upper_arm" not in page.partition("Fitted metrics")[2]
    assert page.count("<svg") + page.count("<img") >= 2


def test_a_report_without_metrics_gives_the_reason() -> None:
    page = render_study_report(analysed(with_poses=False), NAMES, ["no metric was fitted: <two> skeletons"], title="")
    assert "no metric was fitted: &lt;two&gt; skeletons" in page
    assert "No metric was fitted." in page
    assert "best fit" not in page


def test_a_report_without_an_order_gives_the_reason() -> None:
    unordered = replace(analysed(with_poses=False), order=None, refusals=("order: motion 3 was never shown",))
    page = render_study_report(unordered, NAMES, title="walks")
    assert "order: motion 3 was never shown" in page
    assert "The groups have" not in page


def test_groups_that_the_first_component_does_not_separate_are_told() -> None:
    analysis = analysed(with_poses=False)
    assert analysis.order is not None
    mixed = replace(analysis.order, groups=np.arange(MOTIONS) % 2)
    page = render_study_report(replace(analysis, order=mixed), NAMES, title="walks")
    assert "The first component does not separate the groups." in page


def test_a_report_explains_the_columns_of_the_table_of_weights() -> None:
    page = render_study_report(analysed(with_poses=True), NAMES, title="")
    assert "c + N · Σ w F(x)" in page
    assert '<th scope="col" class="number">N</th>' in page
