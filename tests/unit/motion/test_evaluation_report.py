"""Reports of evaluations: one valid HTML file with the measured values, for any names of clips."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.compared_evaluations import compare_results
from tests.support.drawn_evaluations import (
    DEFAULT_FIGURES,
    DRAWN_EVALUATIONS,
    NAMING,
    changed,
    drawn_beside_little,
    drawn_both,
    drawn_hostile,
    drawn_of_little,
    figure_of,
    hostile,
    little,
    usual,
)
from tests.support.evaluation_results import synthetic_result
from tests.support.present import present
from tests.support.report_pages import HOSTILE, Page, is_sound
from tests.support.tiers import is_soak

from marey_motion.evaluation.compare import MetricChange
from marey_motion.evaluation.judgement import GRADES, judge, judge_trial, mean_speed_m_s
from marey_motion.evaluation.result import EvaluationResult, ReplicateValues, TrialResult
from marey_motion.evaluation.scenario import Trial, demand
from marey_motion.evaluation.suite import evaluate
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import SourceClip
from marey_motion.rigs import map_joints
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.markup import element, text
from marey_reports.drawing.words import duration
from marey_reports.evaluation import page as pages
from marey_reports.evaluation.definitions import METRICS, definitions
from marey_reports.evaluation.figures import draw_figure
from marey_reports.evaluation.page import compared, render_comparison, render_report
from marey_reports.evaluation.sentences import region_verdicts, verdict
from marey_reports.evaluation.words import find_holes
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.verdict import VerdictLimits
from marey_schemas.wording import counted

pytestmark = DRAWN_EVALUATIONS


@pytest.fixture(scope="module")
def result() -> EvaluationResult:
    return usual()


@pytest.fixture(scope="module")
def figures() -> dict[str, DrawnFigure]:
    return {name: figure_of(name) for name in DEFAULT_FIGURES}


@pytest.fixture(scope="module")
def page(result: EvaluationResult, figures: dict[str, DrawnFigure]) -> Page:
    return is_sound(render_report(result, title="Walks", figures=figures))


# The page


def test_a_report_is_one_sound_file_that_shows_every_figure(page: Page, figures: dict[str, DrawnFigure]) -> None:
    assert page.tags["svg"] == page.tags["figcaption"] == len(DEFAULT_FIGURES)
    assert page.tags["h1"] == 1
    assert page.text.count("Data to record next") == 2  # the link and the heading
    for figure in figures.values():
        assert figure.caption in page.text


def test_the_same_result_gives_the_same_page(result: EvaluationResult, figures: dict[str, DrawnFigure]) -> None:
    once, again = (render_report(result, title="Walks", figures=figures) for _ in range(2))
    assert once == again


def test_without_figures_a_report_draws_them(
    result: EvaluationResult, figures: dict[str, DrawnFigure], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_soak():  # drawing takes long
        monkeypatch.setattr(pages, "draw_figures", lambda drawn: figures if drawn is result else {})
    assert render_report(result, title="Walks") == render_report(result, title="Walks", figures=figures)


def test_the_page_opens_with_the_verdict(page: Page, result: EvaluationResult) -> None:
    head = "Walks – Evaluation of clips Evaluation of clips Walks Marey 1.2.3 "
    assert page.text.startswith(head + verdict(result))


def test_pictures_and_tables_can_be_read_aloud(result: EvaluationResult, figures: dict[str, DrawnFigure]) -> None:
    source = render_report(result, title="Walks", figures=figures)

    for svg in re.findall(r"<svg.*?</svg>", source, re.DOTALL):
        assert 'role="img"' in svg
        assert re.search(r"<title>[^<]+</title><desc>[^<]+</desc>", svg)
    for table in re.findall(r"<table.*?</table>", source, re.DOTALL):
        assert "<caption>" in table
        assert 'scope="col"' in table
        assert table.count("<tr>") - 1 == table.count('scope="row"')
    assert '<html lang="en">' in source


def test_names_of_clips_and_titles_are_shown_and_never_run(result: EvaluationResult) -> None:
    page = is_sound(render_report(hostile(), title=HOSTILE[1], figures=drawn_hostile()))

    for name in HOSTILE[:3]:
        assert name in page.text
    assert "alert" not in "".join(page.scripts)
    assert "\u202e" not in page.text
    labels = ("<i>", "</td>")
    figures = None if is_soak() else {
        name: draw_figure(name, hostile(), other=result, labels=labels) for name in NAMING
    }  # fmt: skip
    assert is_sound(render_comparison(hostile(), result, title=HOSTILE[0], labels=labels, figures=figures))


def test_notes_of_the_evaluation_are_told(result: EvaluationResult, figures: dict[str, DrawnFigure]) -> None:
    source = render_report(replace(result, notes=("walk_<3> stays in place",)), title="t", figures=figures)
    assert "walk_<3> stays in place" in is_sound(source).text


def test_markup_is_escaped_unless_it_was_made_here() -> None:
    assert element("p", "<b>", element("b", "&"), class_='x"y') == '<p class="x&#34;y">&lt;b&gt;<b>&amp;</b></p>'
    assert element("td", None, ["a", None, "b"], data_value="1", title=None) == '<td data-value="1">ab</td>'
    assert text("a\x00b\ud800") == "a\ufffdb\ufffd"


# What it says


def test_all_trials_and_clips_are_listed_with_their_numbers(page: Page, result: EvaluationResult) -> None:
    for each in result.trials:
        assert demand(each.trial) in page.text
        assert f"{each.metrics['offset_mean']:.2f}" in page.text
    for clip in result.clips:
        assert clip.name in page.text


def test_the_suite_s_numbers_stand_beside_the_baseline_s(
    result: EvaluationResult, figures: dict[str, DrawnFigure]
) -> None:
    base = replace(synthetic_result(seed=9, sway_m=0.02), records=())
    page = is_sound(render_report(replace(result, baseline=base), title="t", figures=figures))

    assert "generated baseline" in page.text
    for name, metric in METRICS.items():
        if name in result.suite:
            assert metric.label in page.text
    assert f"{base.suite['offset_mean']:.2f} m with generated clips" in page.text


def test_the_suite_s_numbers_are_called_means_largest_and_sums_as_they_are(
    result: EvaluationResult, page: Page
) -> None:
    largest = max(present(each.metrics["offset_max"]) for each in result.trials)
    assert "the maximum for the largest distance" in page.text
    assert f"largest distance {largest:.2f}" in page.text


def test_clips_that_were_never_used_are_named(page: Page, result: EvaluationResult) -> None:
    unused = [result.clips[usage.clip].name for usage in result.usage if not usage.ticks]
    start = page.text.index("were displayed in no trial")
    told = page.text[start : page.text.index("Data to record next", start)]

    assert len(unused) == 2
    assert all(name in told for name in unused)
    assert "Every clip was used" in is_sound(render_report(synthetic_result(unused=0), title="t", figures={})).text


def test_digests_and_options_are_there_to_repeat_it(page: Page, result: EvaluationResult) -> None:
    for digest in (result.provenance.dataset, result.provenance.normaliser, result.provenance.options):
        assert digest in page.text
    assert "controller.search_every_s 0.1" in page.text
    assert result.provenance.clips[result.clips[3].uid] in page.text


@pytest.mark.soak
def test_a_report_of_a_thousand_clips_stays_small() -> None:
    big = synthetic_result(clips=1_000, frames=300, unused=300)
    drawn = None if is_soak() else {name: draw_figure(name, big) for name in NAMING}
    source = render_report(big, title="big", figures=drawn)

    assert len(source.encode()) < 5_000_000
    assert f"All {sum(1 for usage in big.usage if not usage.ticks)} names" in source
    is_sound(source)


@pytest.mark.every_nth(2)
@pytest.mark.parametrize("name", ["no records", "nothing used", "no trials", "no numbers"])
def test_reports_are_made_of_little(name: str, result: EvaluationResult) -> None:
    assert drawn_of_little(name)
    is_sound(render_report(little(name), title="little", figures=drawn_of_little(name)))
    is_sound(render_comparison(little(name), result, title="little", figures=drawn_beside_little(name)))


def test_a_real_evaluation_is_reported() -> None:
    options = EvaluationOptions(
        speeds_m_s=(1.25, 2.0), turn_rates_deg_s=(-50.0, 0.0, 50.0), duration_s=6.0, replicates=1
    )
    clips = [
        SourceClip(f"gait{index}", f"gait {index}", generate_gait(speed, turn_rate, 4.0))
        for index, (speed, turn_rate) in enumerate(((1.25, 0.0), (1.25, 0.9), (2.0, 0.0)))
    ]
    skeleton = clips[0].clip.skeleton
    database = build_database(clips, MatchingBody.from_mapping(skeleton, map_joints(skeleton)), options.database)
    real = evaluate(database, options, threads=1, with_baseline=False)
    page = is_sound(render_report(real, title="Real"))

    assert page.tags["figure"] == len(DEFAULT_FIGURES)
    assert verdict(real) in page.text
    assert "turns of 50 degrees a second at 1.25 to 2 m/s" in page.text


# Words


def test_holes_in_words_hold_every_missing_second_once(result: EvaluationResult) -> None:
    holes = find_holes(result.coverage)

    assert sum(hole.missing_s for hole in holes) == pytest.approx(result.coverage.deficit_s.sum())
    assert [hole.missing_s for hole in holes] == sorted((hole.missing_s for hole in holes), reverse=True)
    for hole in holes:
        assert hole.turn_rates_deg_s[0] * hole.turn_rates_deg_s[1] >= 0.0


def test_a_hole_is_told_as_an_animator_says_it(result: EvaluationResult) -> None:
    deficit = np.zeros_like(result.coverage.deficit_s)
    deficit[1:, 3:] = (1.0, 2.0)  # 2 and 3 m/s, 50 and 100 deg/s to the left
    deficit[0, 2] = 0.5
    left, ahead = find_holes(replace(result.coverage, deficit_s=deficit))

    assert left.words == "left turns of 50 to 100 degrees a second at 2 to 3 m/s"
    assert left.missing_s == 6.0
    assert ahead.words == "straight ahead at 1 m/s"
    holed = replace(result, coverage=replace(result.coverage, deficit_s=deficit))
    page = is_sound(render_report(holed, title="t", figures={}))
    assert "left turns of 50 to 100 degrees a second at 2 to 3 m/s: 6.0 s missing" in page.text


def test_amounts_durations_and_demands_are_words() -> None:
    assert [counted(1, "clip"), counted(2, "trajectory"), counted(1200, "cell")] == [
        "1 clip",
        "2 trajectories",
        "1,200 cells",
    ]
    assert [duration(3.21), duration(45.4), duration(200)] == ["3.2 s", "45 s", "3 min 20 s"]
    assert demand(Trial("circle", 1.5, np.radians(-75.0))) == "right turn of 75 deg/s at 1.5 m/s"
    assert demand(Trial("switching", 2.0, 0.0)) == "straight line at 2 m/s switching to 4"


# The verdict


LEFT = Trial("circle", 2.0, 0.9)


def outcome(
    trial: Trial = LEFT, offset: float | None = 0.2, speed: float = 0.0, turn: float | None = 0.0
) -> TrialResult:
    return TrialResult(trial, {"offset_mean": offset, "se_v": speed, "se_omega_deg": turn})


def judged(result: EvaluationResult, followed: int, trials: int) -> EvaluationResult:
    names = [replace(result.trials[0].trial, speed_m_s=1.0 + 0.01 * index) for index in range(trials)]
    return replace(
        result,
        trials=tuple(outcome(trial, offset=0.1 if index < followed else 4.0) for index, trial in enumerate(names)),
    )


@pytest.mark.parametrize(
    ("metrics", "followed"),
    [
        ({}, True),
        ({"offset": 1.0}, True),
        ({"offset": 1.001}, False),
        ({"speed": -0.3}, True),
        ({"speed": 0.301}, False),
        ({"turn": 10.0}, True),
        ({"turn": -10.1}, False),
        ({"offset": None}, False),
        ({"turn": None}, False),
    ],
)
def test_a_trial_is_followed_within_its_three_limits(metrics: dict[str, Any], followed: bool) -> None:
    assert judge_trial(outcome(**metrics), VerdictLimits()).followed is followed


def test_a_switching_trial_is_measured_by_its_mean_speed() -> None:
    assert mean_speed_m_s(Trial("switching", 2.0, 0.0, duration_s=30.0)) == pytest.approx(3.0)
    assert mean_speed_m_s(Trial("switching", 2.0, 0.0, duration_s=12.0)) == pytest.approx(2.0 + 2.0 * 5.0 / 12.0)
    assert mean_speed_m_s(Trial("switching", 2.0, 0.0, duration_s=3.0)) == 2.0


@pytest.mark.parametrize(
    ("followed", "grade"), [(20, "very good"), (15, "very good"), (14, "good"), (11, "good"), (10, "usable in part"),
                            (6, "usable in part"), (5, "poor"), (0, "poor")]
)  # fmt: skip
def test_the_share_of_followed_trials_gives_the_grade(followed: int, grade: str, result: EvaluationResult) -> None:
    judgement = judge(judged(result, followed, 20))
    assert (judgement.grade, judgement.followed, len(judgement.trials)) == (grade, followed, 20)


def test_the_verdict_is_one_sentence_with_the_worst_trial_and_its_reason(result: EvaluationResult) -> None:
    slow = replace(result, trials=(outcome(), outcome(Trial("circle", 3.0, np.radians(-100.0)), speed=-1.62)))
    sentence = verdict(slow)

    assert sentence.startswith(
        "Usable in part: the character follows 1 of 2 trajectories, worst at a right turn of 100"
    )
    assert "at 3 m/s (1.6 m/s too slow)" in sentence
    assert "2 of 12 clips are never used." in sentence
    assert sentence.count(". ") == 0
    little = replace(result, trials=(outcome(Trial("circle", 1.0, np.radians(-50.0)), turn=22.0),))
    assert "(22 deg/s too little)" in verdict(little)
    assert "not measured" in verdict(replace(result, trials=(outcome(offset=None),)))
    assert verdict(replace(result, trials=())) == "Not judged: the evaluation has no trials."


def test_the_definitions_show_the_limits_of_the_evaluation_and_the_shares_of_the_grades() -> None:
    told = definitions(VerdictLimits(speed_share=0.21, skate_m_s=0.33))
    for name, value in VerdictLimits(speed_share=0.21, skate_m_s=0.33).model_dump().items():
        assert name in told
        assert f"{value:g}" in told
    for share, name in GRADES[:-1]:
        assert f"from {100 * share:g} % {name}" in told


def test_numbers_beyond_their_limits_are_marked_where_they_stand(result: EvaluationResult) -> None:
    metrics = {**result.trials[0].metrics, "foot_skate": 0.87, "foot_skate_clips": 0.08, "pose_cost_clips": 0.05,
               "treading_per_s": 2.5, "transitions_per_s": 9.9}  # fmt: skip
    bad = replace(
        result,
        trials=(replace(result.trials[0], metrics=metrics), *result.trials[1:]),
        suite={**result.suite, **metrics, "treading_share": 0.63, "abs_se_omega_deg": 44.1},
    )
    page = render_report(bad, title="t", figures={})
    for written in ("0.87", "9.90", "2.50", "0.63", "44.1"):
        assert re.search(rf'<td[^>]*class="[^"]*bad[^"]*"[^>]*>{written}</td>', page), written


@pytest.mark.parametrize(("count", "said"), [(2, "too few for 95 % intervals."), (3, "their 95 % intervals show how")])
def test_intervals_are_explained_only_where_there_are_any(count: int, said: str, result: EvaluationResult) -> None:
    replicates = ReplicateValues((), np.zeros((1, count, 0)), np.zeros((1, count), dtype=bool), {})
    page = is_sound(render_report(replace(result, replicates=replicates), title="t", figures={}))
    assert f"ran {count} times" in page.text
    assert said in page.text


def test_each_region_gets_a_sentence_and_motion_that_no_trial_asks_for_is_named(result: EvaluationResult) -> None:
    regions = region_verdicts(result)
    assert [each.region for each in regions] == [
        "straight", "gentle turns", "sharp turns", "speed changes", "backwards"
    ]  # fmt: skip
    assert sum(each.trials for each in regions) == len(result.trials)
    assert "no trial asks for it" in regions[-1].sentence
    page = is_sound(render_report(result, title="t", figures={}))
    assert all(each.sentence in page.text for each in regions)


# Comparisons


def replicated(result: EvaluationResult, *counts: int) -> EvaluationResult:
    """Return the evaluation with replicates; the number of followed trials is given for each replicate."""
    trials = len(result.trials)
    followed = np.arange(trials)[:, None] < np.array(counts)
    return replace(result, replicates=ReplicateValues((), np.empty((trials, len(counts), 0)), followed, {}))


def test_a_comparison_says_whether_it_helped(result: EvaluationResult) -> None:
    few, many = replicated(judged(result, 3, 10), 3, 2, 3, 4), replicated(judged(result, 5, 10), 5, 5, 5, 6)
    assert compared(few, many).startswith("Better: the character follows 5.2 of 10 trajectories, 3 before; it is ")
    assert compared(many, few).startswith("Worse: ")
    none = "No difference in followed trajectories found: "
    assert compared(few, few).startswith(f"{none}the character follows 3 of 10 trajectories, as before")
    chance = replicated(judged(result, 5, 10), 2, 5, 1, 6)
    assert compared(few, chance).startswith(none)
    assert compared(result, result).startswith("Unclear, because there are no replicates: ")


def test_a_comparison_names_the_metrics_that_are_better_or_worse(result: EvaluationResult) -> None:
    """Also if as many trajectories are followed: nobody should read that there is no difference."""
    few = replicated(judged(result, 3, 10), 3, 2, 3, 4)
    changes = (
        MetricChange("foot_skate", 0.7, 0.8, 0.1, 0.05, 0.15, 10, 4, 0.001),
        MetricChange("abs_se_v", 0.7, 0.6, -0.1, -0.15, -0.05, 10, 4, 0.001),
        MetricChange("dse_v", 0.7, 0.6, -0.1, -0.25, 0.05, 10, 4, 0.4),
    )
    comparison = replace(compare_results(result, result), metrics=changes)
    sentence = compared(few, few, comparison)
    assert sentence.endswith("; better metrics: speed error; worse metrics: feet slide.")


def test_a_comparison_shows_what_came_went_and_changed(result: EvaluationResult) -> None:
    after = changed()
    page = is_sound(render_comparison(result, after, title="Change", labels=("old", "new"), figures=drawn_both()))

    assert page.tags["figure"] == len(DEFAULT_FIGURES)
    assert "Added clips (1) newcomer" in page.text
    assert "Removed clips (3)" in page.text
    assert f"{present(after.suite['offset_mean']) - present(result.suite['offset_mean']):+.2f}" in page.text
    assert "old → new" in page.text


def test_a_comparison_with_intervals_shows_them_and_the_trials_that_changed(result: EvaluationResult) -> None:
    records = list(result.records)
    records[3] = replace(records[3], positions=records[3].positions + 0.01)
    comparison = compare_results(result, replace(result, records=tuple(records)))
    page = is_sound(
        render_comparison(comparison.before, comparison.after, title="Change", comparison=comparison, figures={})
    )

    assert "The motion of the character changed in 1 of 30 trials." in page.text
    assert "+0.00 to +0.00" in page.text


def test_a_comparison_writes_means_of_counts_with_decimals_and_no_minus_before_nothing(
    result: EvaluationResult,
) -> None:
    trials = tuple(
        replace(each, metrics={**each.metrics, "clip_ends": float(index % 2), "response_missed": -1e-9 * index})
        for index, each in enumerate(result.trials)
    )
    comparison = compare_results(result, replace(result, trials=trials))
    page = is_sound(
        render_comparison(comparison.before, comparison.after, title="Change", comparison=comparison, figures={})
    )

    (ends,) = (one for one in comparison.metrics if one.metric == "clip_ends")
    assert f"clip ends met {ends.before:.1f} {ends.after:.1f} {ends.change:+.1f}" in page.text
    assert "-0.0 " not in page.text
    assert "also for largest distances and counts" in page.text


def test_trials_that_only_show_other_clips_went_the_same_way(result: EvaluationResult) -> None:
    clips = tuple(replace(clip, uid=f"copy-{clip.uid}") for clip in result.clips)
    comparison = compare_results(result, replace(result, clips=clips))
    page = is_sound(
        render_comparison(comparison.before, comparison.after, title="Change", comparison=comparison, figures={})
    )
    assert "changed in 0 of 30 trials. In 30 other trials, it is the same, but from other clips." in page.text


def test_a_comparison_counts_mirrored_twins_once_and_says_when_coverage_is_asked_for_otherwise(
    result: EvaluationResult,
) -> None:
    first, second, *rest = result.clips
    twin = replace(second, mirrored_from=first.uid)
    usage = tuple(replace(one, popularity=np.ones(9, dtype=np.int64)) if one.clip < 2 else one for one in result.usage)
    options = result.options.replace(coverage_least_s=0.25)
    after = replace(result, clips=(first, twin, *rest), usage=usage, options=options)
    page = is_sound(render_comparison(result, after, title="Change", figures={}))
    assert f"of {len(result.clips)} and {len(result.clips) - 1}" in page.text
    assert "not comparable: 1 s and 0.25 s are required" in page.text


def test_what_the_script_sorts_by_is_a_number(result: EvaluationResult, figures: dict[str, DrawnFigure]) -> None:
    source = render_report(result, title="Walks", figures=figures)
    for value in re.findall(r'data-value="([^"]*)"', source):
        assert value == "" or isinstance(json.loads(value), int | float)
