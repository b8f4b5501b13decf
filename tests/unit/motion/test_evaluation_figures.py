"""Figures of evaluations show the measured values, for any evaluation."""

import csv
import io
import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from tests.support.drawn_evaluations import (
    DEFAULT_FIGURES,
    DRAWN_EVALUATIONS,
    LITTLE,
    NAMING,
    changed,
    drawn_beside_little,
    drawn_both,
    drawn_hostile,
    drawn_of_little,
    figure_of,
    tiny,
    usual,
)
from tests.support.drawn_figures import is_sound, is_sound_svg, rows_of
from tests.support.evaluation_results import SMALL, synthetic_result
from tests.support.present import present
from tests.support.tiers import is_soak

from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import Windows, coverage_of
from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import demand
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import Status
from marey_reports.drawing.paper import (
    COLOURS,
    distinct_colours,
    labels_of,
    luminance,
    nice_levels,
    shortened,
    without_shared_folder,
)
from marey_reports.evaluation.figures import (
    FIGURES,
    USE_FIGURES,
    FigureOptions,
    draw_figure,
    draw_figures,
    draw_shared_figures,
    drawable,
)
from marey_reports.evaluation.figures.clip_graph_layout import MOST_DOTS, arrange
from marey_reports.evaluation.figures.mixtures import fit_one, fit_two
from marey_schemas.options.evaluation import EvaluationOptions, Family

pytestmark = DRAWN_EVALUATIONS

ONE_TRIAL = [name for name, kind in FIGURES.items() if kind.trials == "one"]
SMALL_MULTIPLES_APART_IN = 0.26
SWITCHING = "switching v=2 w=50"


@pytest.fixture(scope="module")
def result() -> EvaluationResult:
    return usual()


@pytest.fixture(scope="module")
def other() -> EvaluationResult:
    return changed()


@pytest.mark.every_nth(6)
@pytest.mark.parametrize("name", DEFAULT_FIGURES)
def test_a_figure_has_the_same_bytes_each_time(name: str, result: EvaluationResult) -> None:
    first, second = is_sound_svg(figure_of(name)), draw_figure(name, result)
    assert (first.svg, first.data) == (second.svg, second.data)
    if is_soak():
        assert is_sound(first).files() == second.files()


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("name", DEFAULT_FIGURES)
def test_a_figure_of_two_results_is_sound(name: str) -> None:
    is_sound_svg(drawn_both()[name])


@pytest.mark.soak
@pytest.mark.parametrize("name", DEFAULT_FIGURES)
def test_a_figure_of_two_results_is_the_same_drawing_each_time(
    name: str, result: EvaluationResult, other: EvaluationResult
) -> None:
    first, second = drawn_both()[name], draw_figure(name, result, other=other, labels=("old", "new"))
    assert (first.svg, first.data) == (second.svg, second.data)
    assert is_sound(first).png == second.png


def test_threads_draw_the_same_figures_at_once(result: EvaluationResult) -> None:
    def draw(_: int) -> tuple[str, bytes]:
        figure = draw_figure("scenario-switching", result)
        return figure.svg, figure.png

    with ThreadPoolExecutor(4) as pool:
        pictures = list(pool.map(draw, range(4)))

    alone = figure_of("scenario-switching")
    assert set(pictures) == {(alone.svg, alone.png)}


def test_drawing_leaves_the_settings_of_matplotlib_alone(result: EvaluationResult) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    draw_figure("holes", result)
    assert dict(matplotlib.rcParams) == before


def test_matplotlib_is_not_loaded_before_something_is_drawn() -> None:
    script = "import sys, marey_reports.evaluation.page; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_the_files_of_a_figure_are_its_pictures_and_its_data(result: EvaluationResult) -> None:
    figure = figure_of("errors")
    files = figure.files()

    assert set(files) == {"errors.png", "errors.svg", "errors.json", "errors-histogram.csv", "errors-fits.csv"}
    assert json.loads(files["errors.json"]) == figure.data
    rows = list(csv.DictReader(io.StringIO(files["errors-fits.csv"].decode())))
    assert [float(row["mean"]) for row in rows] == figure.data["tables"]["fits"]["mean"]


def test_all_figures_of_a_result_are_drawn_but_those_it_has_no_trials_or_records_for() -> None:
    assert list(drawn_both()) == list(DEFAULT_FIGURES)
    circles = synthetic_result(SMALL.replace(families=("circle",)), clips=3, frames=100)
    assert set(FIGURES) - set(drawable(circles)) == {"scenario-switching", "scenario-course"}
    without_records = replace(circles, records=())
    assert set(FIGURES) - set(draw_figures(without_records)) == set(ONE_TRIAL)


# Figure 1


def test_points_are_the_windows_of_the_coverage(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("points"), "points")
    coverage = result.coverage

    assert [row["speed_m_s"] for row in rows] == coverage.speed_m_s.tolist()
    assert [row["turn_rate_deg_s"] for row in rows] == np.degrees(coverage.turn_rate_rad_s).tolist()
    assert [row["clip"] for row in rows] == [result.clips[clip].uid for clip in coverage.clip]


def test_of_very_many_windows_evenly_spaced_ones_are_drawn() -> None:
    big = synthetic_result(clips=300, frames=500)
    figure = draw_figure("points", big)
    drawn = figure.data["tables"]["points"]["speed_m_s"]

    assert 3_000 <= len(drawn) <= 6_000
    assert drawn == big.coverage.speed_m_s[:: -(-len(big.coverage.clip) // 6_000)].tolist()
    assert "280 other clips" in figure.svg


# Figures 4a and 4b


def test_a_scenario_has_the_approach_and_a_section_for_each_speed(result: EvaluationResult) -> None:
    sections = rows_of(figure_of("scenario-switching", SWITCHING), "sections")

    assert [row["section"] for row in sections] == [1, 2, 3, 4]
    assert [row["speed_m_s"] for row in sections] == [2.0, 2.0, 4.0, 2.0]
    assert [(row["start_s"], row["stop_s"]) for row in sections] == [(0, 3), (3, 8), (8, 13), (13, 15)]
    assert [row["turn_rate_deg_s"] for row in sections] == pytest.approx([0.0, 50.0, 50.0, 50.0])


def test_a_scenario_shows_where_the_character_went_beside_where_it_should_have(
    result: EvaluationResult, other: EvaluationResult
) -> None:
    name = "circle v=1 w=100"
    index = [each.trial.name for each in result.trials].index(name)
    paths = draw_figure("scenario-circle", result, trial=name, other=other, labels=("old", "new")).tables["paths"]

    assert np.array_equal(paths["old_x_m"], result.records[index].positions[:, 0])
    assert np.array_equal(paths["new_z_m"], other.records[index].positions[:, 1])
    assert np.max(np.asarray(paths["reference_x_m"])) > 0.5  # a left turn


def test_scenarios_can_be_drawn_without_records(result: EvaluationResult) -> None:
    bare = replace(result, records=())
    assert set(draw_figure("scenario-circle", bare).tables["paths"]) == {"time_s", "reference_x_m", "reference_z_m"}


# Figure 5


def test_offsets_are_those_of_the_trials(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("offsets"), "offsets")
    drawn = {(row["family"], row["speed_m_s"], round(row["turn_rate_deg_s"])): row["offset_mean_m"] for row in rows}

    assert len(drawn) == len(result.trials) == 30
    for each in result.trials:
        key = each.trial.family, each.trial.speed_m_s, round(np.degrees(each.trial.turn_rate_rad_s))
        assert drawn[key] == each.metrics["offset_mean"]


def test_titles_of_many_results_end_before_the_next_panel() -> None:
    names = [f"walks/{number}_with_a_name_that_is_much_too_long_for_a_panel" for number in range(5)]
    for figure in draw_shared_figures([usual()] * len(names), names).values():
        drawn = figure.sketch.figure
        panels = [axes for axes in drawn.axes if axes.get_title("left")]
        assert len({axes.get_title("left") for axes in panels}) == len(names)
        for axes in panels:
            title = next(text for text in axes.findobj(Text) if text.get_text() == axes.get_title("left"))
            beyond_in = (title.get_window_extent().x1 - axes.get_window_extent().x1) / drawn.dpi
            assert beyond_in < SMALL_MULTIPLES_APART_IN, figure.name


def test_the_colour_scale_of_a_change_is_labelled_at_no_change_and_evenly_on_both_sides() -> None:
    result = usual()
    farther = tuple(
        replace(one, metrics={**one.metrics, "offset_mean": present(one.metrics["offset_mean"]) + 1.3})
        for one in result.trials
    )
    results = [result, replace(result, trials=farther)]
    drawn = draw_shared_figures(results, ["before", "after"])["offsets"].sketch.figure
    bar = next(axes for axes in drawn.axes if axes.get_xlabel().startswith("change of the mean offset"))
    labels = [float(label.get_text()) for label in bar.get_xticklabels()]
    assert labels == pytest.approx([-1.2, -0.6, 0.0, 0.6, 1.2])


def test_levels_of_a_scale_are_round_numbers_that_reach_the_largest_value() -> None:
    assert nice_levels(0.61).tolist() == pytest.approx(np.arange(0, 0.71, 0.1).tolist())
    assert nice_levels(14.0).tolist() == list(range(0, 15, 2))
    assert nice_levels(1.0)[-1] == pytest.approx(1.0)
    assert nice_levels(0.0)[-1] == 1.0


# Figure 6


@pytest.mark.parametrize(("name", "cell"), [("density", 50.0 * 1.0), ("directions", 0.25 * 0.25)])
def test_the_map_of_density_holds_all_seconds_of_data(name: str, cell: float, result: EvaluationResult) -> None:
    table = figure_of(name).data["tables"]["density"]
    x, y = (np.unique(values) for values in list(table.values())[:2])
    fine = (x[1] - x[0]) * (y[1] - y[0])
    held = np.sum(table["seconds_s"]) * fine / cell

    # What lies near or beyond the border is not all drawn.
    assert held == pytest.approx(len(result.coverage.clip) / 60.0, rel=0.15)


# Figure 7


def test_transition_costs_and_switches_are_those_of_the_record(result: EvaluationResult) -> None:
    table = figure_of("transition-cost", SWITCHING).tables["costs"]
    record = result.records[[each.trial.name for each in result.trials].index(SWITCHING)]

    assert np.array_equal(table["pose_cost_m"], record.pose_cost[1:])
    assert np.array_equal(table["switched"], record.status[1:] == Status.REPLACING)
    assert set(np.asarray(table["wished_speed_m_s"])) == {2.0, 4.0}


# Figure 8


def test_one_normal_has_the_static_error_as_its_mean_and_the_sign_can_be_turned(result: EvaluationResult) -> None:
    trial = "circle v=3 w=-50"
    metrics = next(each.metrics for each in result.trials if each.trial.name == trial)
    for negate, sign in ((False, 1.0), (True, -1.0)):
        rows = rows_of(draw_figure("errors", result, trial=trial, options=FigureOptions(negate_errors=negate)), "fits")
        one = {row["quantity"]: row for row in rows if row["components"] == 1}
        assert one["speed_m_s"]["mean"] == pytest.approx(sign * present(metrics["se_v"]), abs=1e-12)
        assert one["speed_m_s"]["deviation"] == pytest.approx(metrics["dse_v"], abs=1e-12)
        assert one["turn_rate_deg_s"]["mean"] == pytest.approx(sign * present(metrics["se_omega_deg"]), abs=1e-9)


@pytest.mark.parametrize("name", ["errors", "transition-cost"])
def test_the_title_says_in_words_and_units_what_the_trial_asks_for(name: str, result: EvaluationResult) -> None:
    figure = figure_of(name, SWITCHING)
    assert ">left turn of 50 deg/s at 2 m/s switching to 4<" in figure.svg
    assert SWITCHING not in figure.svg + figure.caption


def test_the_histogram_holds_the_evaluated_seconds(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("errors", SWITCHING), "histogram")
    for quantity in ("speed_m_s", "turn_rate_deg_s"):
        held = sum(row["seconds"] for row in rows if row["quantity"] == quantity)
        assert held == pytest.approx(12.0, abs=0.1)


def test_two_normals_are_found_again() -> None:
    random = np.random.default_rng(0)
    values = np.concatenate((random.normal(-0.1, 0.2, 3_000), random.normal(-1.5, 0.1, 2_000)))
    begins = np.arange(5_000) >= 2_800  # the begin need not be right

    fit = fit_two(values, begins)
    assert fit.means == pytest.approx((-1.5, -0.1), abs=0.02)
    assert fit.deviations == pytest.approx((0.1, 0.2), abs=0.02)
    assert fit.weights == pytest.approx((0.4, 0.6), abs=0.02)


def test_a_fit_without_spread_or_without_groups_is_still_one() -> None:
    fit = fit_two(np.full(50, 0.3), np.zeros(50, dtype=bool))
    assert fit.means == pytest.approx((0.3, 0.3))
    assert fit.weights.sum() == 1.0
    split = fit_two(np.repeat([0.0, 1.0], 50), np.zeros(100, dtype=bool))
    assert split.means == pytest.approx((0.0, 1.0))
    assert np.isfinite(fit_one(np.full(3, 2.0)).density(np.zeros(1))).all()


# Figure 9


def test_usage_counts_the_frames_of_every_clip_and_the_transitions(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("usage"), "usage")

    assert {row["clip"]: row["frames"] for row in rows[:-1]} == {
        result.clips[usage.clip].uid: usage.ticks for usage in result.usage
    }
    assert rows[-1]["name"] == "Transitions"
    assert rows[-1]["frames"] == sum(present(each.metrics["transitions"]) for each in result.trials)
    total = sum(row["frames"] for row in rows[:-1])
    most = max(row["frames"] for row in rows[:-1])
    assert f">{most:,} ({100 * most / total:.1f} %)<" in figure_of("usage").svg


def test_usage_of_one_trial_is_that_of_its_record(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("usage", SWITCHING), "usage")
    record = result.records[[each.trial.name for each in result.trials].index(SWITCHING)]

    assert sum(row["frames"] for row in rows[:-1]) == len(record.rows)


def test_less_used_clips_are_one_bar(result: EvaluationResult) -> None:
    figure = draw_figure("usage", result, options=FigureOptions(most_clips=4, logarithmic=True))

    assert "6 other clips" in figure.svg
    assert len(figure.data["tables"]["usage"]["clip"]) == 13


# Figure 10


def test_the_dots_hold_all_displayed_frames_and_the_lines_all_jumps(result: EvaluationResult) -> None:
    figure = figure_of("clip-graph")
    frames, lines = rows_of(figure, "frames"), rows_of(figure, "transitions")

    for usage in result.usage:
        mine = [row for row in frames if row["clip"] == result.clips[usage.clip].uid]
        assert sum(row["ticks"] for row in mine) == usage.ticks
        for row in mine:
            assert row["ticks"] == usage.popularity[row["first_frame"] : row["stop_frame"]].sum()
    assert sum(row["count"] for row in lines) == result.switches[:, 2].sum()
    assert len(lines) <= 400


def test_lines_of_many_clips_are_joined_rather_than_left_out() -> None:
    big = synthetic_result(clips=40, unused=0, seed=3)
    figure = draw_figure("clip-graph", big)
    shown = set(figure.data["tables"]["frames"]["clip"])
    uids = [clip.uid for clip in big.clips]
    starts = [clip.start for clip in big.clips]
    inside = [
        count
        for left, entered, count in big.switches
        if uids[np.searchsorted(starts, left, side="right") - 1] in shown
        and uids[np.searchsorted(starts, entered, side="right") - 1] in shown
    ]

    assert len(shown) == 20
    assert len(figure.data["tables"]["transitions"]["count"]) <= 400
    assert sum(figure.data["tables"]["transitions"]["count"]) == sum(inside)
    lines = next(one for one in figure.sketch.figure.axes[0].collections if isinstance(one, PathCollection))
    colours = {tuple(colour) for colour in np.round(np.asarray(lines.get_edgecolor())[:, :3], 6)}
    assert len(colours) == len(set(figure.data["tables"]["transitions"]["from_clip"])) > len(COLOURS)


@pytest.mark.parametrize("count", [2, 6, 7, 24])
def test_colours_of_clips_differ_and_are_visible_on_light_and_dark_pages(count: int) -> None:
    colours = np.array([to_rgb(colour) for colour in distinct_colours(count)])
    apart = np.linalg.norm(colours[:, None] - colours, axis=-1) + np.eye(count)
    assert apart.min() > 0.1
    light = luminance(colours)
    assert ((1.05 / (light + 0.05) > 1.6) & ((light + 0.05) / 0.06 > 2.4)).all(), "contrast to #ffffff and #161a21"


def test_where_nothing_changes_a_map_of_changes_shows_the_page() -> None:
    both = drawn_both()
    for name in ("density", "directions", "offsets"):
        figure = both[name].sketch.figure
        panels = [axes for axes in figure.axes if axes.get_title(loc="left") == "change"]
        assert panels, name
        assert np.asarray(panels[0].get_facecolor())[-1] == 0.0, "the panel itself has no ground"
        maps = [one.get_cmap() for one in panels[0].collections if one.get_array() is not None]
        assert maps
        for colours in maps:
            low, middle, high = np.asarray(colours((0.0, 0.5, 1.0)))
            assert (low[3], middle[3], high[3]) == (1.0, 0.0, 1.0)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 24])
def test_circles_touch_none_other_and_hold_each_frame_in_one_dot(count: int) -> None:
    frames = {f"clip{index}": 5 + 400 * index for index in range(count)}
    circles = list(arrange(frames, {("clip0", "clip2"): 9}).values())

    for first in range(count):
        for second in range(first):
            apart = np.linalg.norm(circles[first].centre - circles[second].centre)
            assert apart > circles[first].radius + circles[second].radius
    assert sum(circle.dots for circle in circles) <= MOST_DOTS + 12 * count
    for circle in circles:
        dots = circle.dot_of(np.arange(circle.frames))
        assert np.array_equal(np.unique(dots), np.arange(circle.dots))
        assert np.array_equal(circle.bounds, np.searchsorted(dots, np.arange(circle.dots + 1)))


# Holes, and use of frames


def test_holes_are_the_deficits_of_the_coverage(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("holes"), "holes")

    assert [row["missing_s"] for row in rows] == result.coverage.deficit_s.ravel().tolist()
    assert [row["seconds_s"] for row in rows] == result.coverage.seconds.ravel().tolist()
    assert [row["turn_rate_deg_s"] for row in rows[:5]] == pytest.approx([-100, -50, 0, 50, 100])


def test_the_use_of_frames_averages_their_popularity(result: EvaluationResult) -> None:
    rows = rows_of(figure_of("frame-use"), "stretches")
    most = max(result.usage, key=lambda usage: usage.ticks)
    mine = [row for row in rows if row["clip"] == result.clips[most.clip].uid]
    sizes = np.diff(np.append(np.arange(len(mine)) * len(most.popularity) // len(mine), len(most.popularity)))

    assert np.dot([row["ticks_per_frame"] for row in mine], sizes) == pytest.approx(most.ticks)


@pytest.mark.parametrize("family", ["stopping", "corners", "eights", "strafing"])
def test_each_course_is_drawn_with_its_sections_and_described(family: Family) -> None:
    made = synthetic_result(SMALL.replace(families=(family,), duration_s=12.0), clips=3, frames=100)
    figures = draw_figures(made) if is_soak() else {"scenario-course": draw_figure("scenario-course", made)}
    drawn = is_sound_svg(figures["scenario-course"])
    assert demand(judge(made).ranked[0].outcome.trial) in drawn.caption
    sections = rows_of(drawn, "sections")
    assert len(sections) == (2 if family == "strafing" else 1 + int(np.ceil(12.0 / (sections[1]["stop_s"] - 3.0))))
    names = drawable(made)
    assert set(figures) <= set(names)
    assert ("offsets" in names) == (family in ("stopping", "eights"))
    assert not {"scenario-circle", "scenario-switching", "errors"} & set(names)


# What is asked for


def test_without_a_name_the_trial_that_went_worst_is_shown(result: EvaluationResult) -> None:
    ranked = (each.outcome.trial for each in judge(result).ranked)
    worst = next(trial for trial in ranked if trial.family == "switching")
    assert demand(worst) in figure_of("transition-cost").svg


def test_what_there_is_not_is_refused(result: EvaluationResult) -> None:
    for name, trial, code in (
        ("offset", None, "unknown-figure"),
        ("errors", "circle v=9 w=0", "unknown-trial"),
        ("usage", "circle v=9 w=0", "unknown-trial"),
        ("scenario-circle", SWITCHING, "unknown-trial"),
        ("density", SWITCHING, "figure-without-trial"),
    ):
        with pytest.raises(MotionError) as refused:
            draw_figure(name, result, trial=trial)
        assert refused.value.code == code
    with pytest.raises(MotionError) as refused:
        draw_figure("errors", replace(result, records=()))
    assert refused.value.code == "records-missing"


# Evaluations of little

ALONE = ("clips of one frame", "no transitions", "one trial")
"""Evaluations that are not compared with another one."""


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("name", LITTLE)
def test_evaluations_of_little_are_drawn(name: str) -> None:
    assert drawn_of_little(name)
    for figure in drawn_of_little(name).values():
        is_sound(figure) if is_soak() else is_sound_svg(figure)


@pytest.mark.every_nth(6)
@pytest.mark.parametrize("name", [name for name in LITTLE if name not in ALONE])
def test_evaluations_of_little_are_compared(name: str) -> None:
    assert drawn_beside_little(name)
    for figure in drawn_beside_little(name).values():
        is_sound(figure) if is_soak() else is_sound_svg(figure)


def standing() -> EvaluationResult:
    """Return the evaluation of a clip that stands still except for rounding errors."""
    made = tiny(
        (DatabaseClip("only", "only", "", 0, 900),),
        EvaluationOptions(speeds_m_s=(1.0,), turn_rates_deg_s=(0.0,), duration_s=6.0),
    )
    sway, count = 1e-7 * np.random.default_rng(7).normal(size=(2, 840)), 840
    windows = Windows(np.hypot(*sway), np.zeros(count), *sway)
    names = ("positions", "headings", "pose_cost")
    records = tuple(replace(one, **{name: 1e-9 * getattr(one, name) for name in names}) for one in made.records)
    coverage = coverage_of(windows, np.zeros(count, np.int32), (), made.options, window_s=1 / 60)
    return replace(made, records=records, coverage=coverage)


def test_of_a_clip_that_stands_rounding_is_not_shown_as_motion() -> None:
    still = standing()
    figures = {name: draw_figure(name, still) for name in DEFAULT_FIGURES if name not in USE_FIGURES or is_soak()}
    assert "0 % of the time backward, 0 % mainly sideways." in figures["directions"].caption
    assert "840 windows from 1 clip, all" in figures["points"].caption
    for figure in figures.values():
        assert not re.search(r">1e", figure.svg.replace("\N{MINUS SIGN}", "-"))  # an axis in powers of ten


def test_names_of_clips_are_drawn_as_they_are_but_for_signs_that_cannot_be() -> None:
    assert set(drawn_hostile()) >= set(NAMING)
    for name, figure in drawn_hostile().items():
        is_sound(figure) if name == "points" or is_soak() else is_sound_svg(figure)
        assert "<b>" not in figure.svg
    assert shortened("a" * 20 + "b" * 20, 11) == "aaaaa…bbbbb"[:11]


def test_labels_leave_out_the_folder_that_all_clips_lie_in() -> None:
    assert without_shared_folder(["lab/walks/a_01", "lab/walks/a_02"]) == ["a_01", "a_02"]
    assert without_shared_folder(["lab/walks/a", "lab/runs/a"]) == ["walks/a", "runs/a"]
    assert without_shared_folder(["walk", "wander"]) == ["walk", "wander"]
    assert without_shared_folder([]) == []


def test_labels_tell_clips_apart_however_long_their_names_are() -> None:
    takes = [f"set/walks/dataset-1_{action}_001" for action in ("walk-left_feminine", "walk-right_feminine", "run_sad")]
    assert labels_of(takes) == ["walk-left_feminine_001", "walk-right_feminine_001", "run_sad_001"]
    assert labels_of(["cmu/16_15", "cmu/16_17"]) == ["16_15", "16_17"]
    for longest in (13, 18, 30):
        labels = labels_of([f"{'a' * 20}{number}{'b' * 20}" for number in range(9)], longest)
        assert len(set(labels)) == 9
        assert all(len(label) <= longest for label in labels)
    assert labels_of(["set/walks/a_001", "other/runs/b_001"]) == ["a_001", "b_001"]
    assert labels_of(["set/walks/a", "other/runs/a"]) == ["set/walks/a", "other/runs/a"]
    assert labels_of(["take", "take"]) == ["take", "take"]
    assert labels_of([]) == []


def test_a_clip_has_the_same_label_in_the_graphs_of_both_results() -> None:
    takes = [f"set/walks/dataset-1_walk-left_feminine_{take:03d}" for take in range(10)]
    before = synthetic_result(names=takes)
    other = replace(before.clips[0], uid="new@1", name="more/dataset-2_walk-turn-left_active_001")
    svg = draw_figure("clip-graph", before, other=replace(before, clips=(other, *before.clips[1:]))).svg
    labels = re.findall(r">([^<>]+)</text>", svg)
    second = [label for label in labels if label.endswith("001") and not label.startswith("2")]
    assert len(second) == 2
    assert len(set(second)) == 1


def test_bars_of_usage_are_called_by_what_tells_their_clips_apart() -> None:
    names = [
        f"set/walks/walk-{side}_feminine_before_noon_{take:03d}" for side in ("left", "right") for take in range(5)
    ]
    drawn = draw_figure("usage", synthetic_result(names=names)).svg
    assert ">left_feminine_before_noon_000<" in drawn
    assert ">right_feminine_before_noon_000<" in drawn
    assert ">Transitions<" in drawn
    assert "set/walks" not in drawn
