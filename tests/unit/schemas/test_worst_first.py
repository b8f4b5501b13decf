"""The order of everything that is called the worst."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from random import Random

from tests.support.evaluation_results import synthetic_result

from marey_client.handles.evaluations import trial_rows, worst_rows_first
from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.result_documents import result_to_tree
from marey_reports.evaluation.figures.subjects import Subject, choose_trial
from marey_reports.evaluation.page import render_report
from marey_reports.evaluation.played import choose_played
from marey_schemas.documents.worst_first import increase, middle_of, worst_first

ROWS = [("b", 1.0), ("a", 1.0), ("c", 3.0), ("e", None), ("d", math.nan), ("f", math.inf)]


def order_of(rows: Sequence[tuple[str, float | None]], *, undefined_is_worst: bool = False) -> str:
    ranked = worst_first(rows, lambda row: row[1], lambda row: row[0], undefined_is_worst=undefined_is_worst)
    return "".join(name for name, _ in ranked)


def test_ties_are_in_the_order_of_names_whatever_the_order_of_the_rows() -> None:
    assert {order_of(rows) for rows in permutations(ROWS)} == {"fcabde"}
    assert {order_of(rows, undefined_is_worst=True) for rows in permutations(ROWS)} == {"defcab"}


def test_the_typical_row_is_in_the_middle_and_a_change_needs_both_values() -> None:
    assert [middle_of(list(range(count))) for count in (1, 2, 3, 4)] == [0, 0, 1, 1]
    assert (increase(1.0, 3.0), increase(None, 3.0), increase(1.0, None)) == (2.0, None, None)


def test_report_stored_result_and_client_agree_on_the_worst_trials_also_if_they_are_equally_bad() -> None:
    result = synthetic_result()
    same = result.trials[0].metrics
    shuffled = list(zip(result.trials, result.records, strict=True))
    Random(3).shuffle(shuffled)
    trials = tuple(replace(trial, metrics=same, regimes={}) for trial, _ in shuffled)
    for equally_bad in (False, True):
        of = replace(
            result, trials=trials if equally_bad else tuple(trial for trial, _ in shuffled),
            records=tuple(record for _, record in shuffled),
        )  # fmt: skip
        ranked = [each.outcome.trial.name for each in judge(of).ranked]
        assert [row["trial"] for row in worst_rows_first(trial_rows(result_to_tree(of)))] == ranked
        assert choose_trial([Subject("", of)], None, ("circle",)).name == next(
            name for name in ranked if name.startswith("circle")
        )
        (_, worst, record), (_, typical, _) = choose_played(of)
        assert worst.outcome.trial.name == ranked[0]
        assert record is of.records[[each.trial.name for each in of.trials].index(ranked[0])]
        assert ranked.index(typical.outcome.trial.name) == len(ranked) // 2
        page = render_report(of, title="t", figures={})
        titles = [part.partition('"')[0] for part in page.partition("The worst trials;")[2].split('title="')[1:11]]
        assert titles == ranked[:10]


def test_trials_of_old_evaluations_are_ranked_by_their_distance_from_the_path() -> None:
    rows = [{"trial": "b", "offset_mean": 1.0}, {"trial": "a", "offset_mean": 1.0}, {"trial": "c", "offset_mean": 2.0}]
    assert [row["trial"] for row in worst_rows_first(rows)] == ["c", "a", "b"]
