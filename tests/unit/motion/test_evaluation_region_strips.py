"""Poses of the worst, a typical and the best trial of each region, in the report of an evaluation."""

from dataclasses import replace

import pytest
from tests.support.evaluation_results import synthetic_result
from tests.support.report_pages import is_sound

from marey_motion.evaluation.judgement import Region, judge
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import demand
from marey_motion.gait import generate_gait
from marey_reports.drawing.strips import EVEN_POSES
from marey_reports.evaluation.page import render_report
from marey_reports.evaluation.region_strips import PosedTrial, choose_by_region, poses_of


def only(result: EvaluationResult, regions: dict[Region, int]) -> EvaluationResult:
    """Return a result with the given number of trials of each region, and no others."""
    left = dict(regions)
    kept = []
    for number, one in enumerate(judge(result).trials):
        if left.get(one.region, 0) > 0:
            left[one.region] -= 1
            kept.append(number)
    assert not any(left.values())
    return replace(
        result,
        trials=tuple(result.trials[number] for number in kept),
        records=tuple(result.records[number] for number in kept),
    )


def test_each_region_has_its_worst_its_best_and_a_trial_between_them() -> None:
    result = synthetic_result()
    chosen = choose_by_region(result)
    strains: dict[Region, dict[str, float]] = {}
    for region, role, verdict, record in chosen:
        assert verdict.region == region
        assert record is result.records[[one.trial.name for one in result.trials].index(verdict.outcome.trial.name)]
        strains.setdefault(region, {})[role] = verdict.worst.strain
    assert set(strains) == {one.region for one in judge(result).trials}
    for region, by_role in strains.items():
        of = [one.worst.strain for one in judge(result).trials if one.region == region]
        assert (by_role["worst"], by_role["best"]) == (max(of), min(of))
        assert by_role["best"] <= by_role["typical"] <= by_role["worst"]


@pytest.mark.parametrize(("count", "roles"), [(1, ["only"]), (2, ["worst", "best"]), (3, ["worst", "typical", "best"])])
def test_no_trial_stands_twice_for_a_region_with_few_trials(count: int, roles: list[str]) -> None:
    chosen = choose_by_region(only(synthetic_result(), {"sharp turns": count}))
    assert [role for _, role, _, _ in chosen] == roles
    assert len({verdict.outcome.trial.name for _, _, verdict, _ in chosen}) == count


def test_a_result_without_records_has_no_poses() -> None:
    assert choose_by_region(replace(synthetic_result(), records=())) == []


def test_the_page_shows_and_names_each_chosen_trial() -> None:
    result = synthetic_result()
    poses = poses_of(generate_gait(1.3, 0.2, 2.0))
    assert len(poses) == EVEN_POSES
    posed = [PosedTrial(region, role, verdict, poses) for region, role, verdict, _ in choose_by_region(result)]
    page = is_sound(render_report(result, title="t", figures={}, posed=posed))
    for one in posed:
        assert f"{one.region}: {one.role}" in page.text
        assert demand(one.verdict.outcome.trial) in page.text
    assert "What each region looks like" not in is_sound(render_report(result, title="t", figures={})).text
