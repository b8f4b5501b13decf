"""Whole evaluations of generated walks and runs, from clips to measured values."""

from itertools import product
from math import radians
from typing import Any

import numpy as np
import pytest
from tests.support.present import present

from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation import suite as suites
from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import reference, suite_trials
from marey_motion.evaluation.suite import assemble, evaluate, evaluate_baseline, run_suite
from marey_motion.gait import GaitStyle, generate_gait
from marey_motion.matching import copies
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.controller import run_trial
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.search import SearchIndex, build_index
from marey_motion.rigs import map_joints
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import DatabaseOptions

TURN_RATES = (-100.0, -75.0, -50.0, -25.0, 0.0, 25.0, 50.0, 75.0, 100.0)
CIRCLES = EvaluationOptions(speeds_m_s=(1.0, 2.0, 3.0), turn_rates_deg_s=TURN_RATES, families=("circle",), replicates=1)
IMPOSSIBLE_M_S = 20.0
RIGID = GaitStyle(bounce=0.0, lean=0.0, sway=0.0, arm_swing=0.0)
SMALL = EvaluationOptions(
    speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(-50.0, 0.0, 50.0), duration_s=6.0, switch_every_s=2.0, replicates=1
)


def gait_clips(cells: Any, seconds: float, *, varied: bool = False) -> list[SourceClip]:
    return [
        SourceClip(
            f"gait-{number:03d}",
            f"v={speed:g} w={turn_rate:g}",
            generate_gait(speed, radians(turn_rate), seconds, style=GaitStyle.varied(number) if varied else None),
        )
        for number, (speed, turn_rate) in enumerate(cells)
    ]


def database_of(clips: list[SourceClip], options: DatabaseOptions | None = None, **given: Any) -> MatchingDatabase:
    skeleton = clips[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(clips, body, options or DatabaseOptions(), **given)


def evaluated(database: MatchingDatabase, options: EvaluationOptions) -> EvaluationResult:
    trials = suite_trials(options)
    return assemble(database, options, trials, run_suite(database, options, trials=trials))


@pytest.fixture(scope="module")
def grid_clips() -> list[SourceClip]:
    return gait_clips(product(CIRCLES.speeds_m_s, CIRCLES.turn_rates_deg_s), 10.0)


def test_a_mirror_closed_data_set_turns_alike_to_both_sides() -> None:
    clips = gait_clips(((v, w) for v in CIRCLES.speeds_m_s for w in CIRCLES.turn_rates_deg_s if w >= 0.0), 10.0)
    mirrored = DatabaseOptions(mirroring="add")
    # From the first tick on the circle: the way straight ahead has no side, and begins on the same foot for both.
    options = CIRCLES.replace(approach_s=0.0, database=mirrored)
    result = evaluated(database_of(clips, mirrored), options)

    assert present(result.suite["offset_asymmetry"]) < 1e-12
    assert result.coverage.symmetry == 1.0
    assert result.coverage.index == 1.0


@pytest.mark.parametrize("family", ["circle", "switching"])
def test_a_mirrored_data_set_does_to_the_right_what_the_original_does_to_the_left(family: str) -> None:
    generator = np.random.default_rng(7)
    cells = np.stack((generator.uniform(0.8, 3.2, 25), generator.uniform(-30.0, 110.0, 25)), axis=1).tolist()
    clips = gait_clips(cells, 6.0, varied=True)
    options = CIRCLES.replace(
        families=(family,), speeds_m_s=(1.0, 2.0, 3.0), turn_rates_deg_s=(25.0, -50.0, 75.0, -100.0)
    )
    opposite = options.replace(speeds_m_s=(1.0, 2.0, 3.0), turn_rates_deg_s=(-25.0, 50.0, -75.0, 100.0))
    plain = evaluated(database_of(clips), options)
    mirrored = evaluated(database_of(clips, DatabaseOptions(mirroring="only")), opposite)

    for one, other, record, twin in zip(plain.trials, mirrored.trials, plain.records, mirrored.records, strict=True):
        assert np.array_equal(record.rows, twin.rows)
        for name, value in one.metrics.items():
            turned = name in ("se_omega_deg", "se_omega_path_deg", "cross_track_mean")
            expected = -present(other.metrics[name]) if turned and value is not None else other.metrics[name]
            assert value == pytest.approx(expected, abs=1e-9), name
    assert mirrored.coverage.symmetry == pytest.approx(plain.coverage.symmetry, abs=1e-12)
    assert present(plain.suite["offset_mean"]) > 0.1  # the trials are not trivially the same


def test_clips_that_own_every_cell_follow_every_circle(grid_clips: list[SourceClip]) -> None:
    result = evaluated(database_of(grid_clips), CIRCLES)

    assert max(present(one.metrics["offset_mean"]) for one in result.trials) < 0.8
    assert max(present(one.metrics["abs_se_v"]) for one in result.trials) < 0.2
    assert max(present(one.metrics["abs_se_omega_deg"]) for one in result.trials) < 3.0
    assert not result.coverage.deficit_s.any()


def test_without_tight_turns_the_tight_circles_are_missed_and_the_others_are_not(grid_clips: list[SourceClip]) -> None:
    options = CIRCLES
    wide = [clip for clip in grid_clips if abs(float(clip.name.split("w=")[1])) <= 70.0]
    result = evaluated(database_of(wide), options)
    offsets = np.array([one.metrics["offset_mean"] for one in result.trials]).reshape(3, 9)

    assert offsets[:, [0, 1, 7, 8]].min() > 1.2
    assert offsets[:, [0, 8]].min() > 2.0
    assert offsets[:, 2:7].max() < 1.0
    lacking = result.coverage.deficit_s > 0.0
    assert lacking[:, [0, 1, 7, 8]].all()
    assert not lacking[:, 2:7].any()
    assert result.coverage.index == pytest.approx(5 / 9)


def test_the_windows_of_a_generated_circle_lie_at_its_speed_and_turn_rate() -> None:
    clip = generate_gait(2.0, radians(50.0), 10.0 + 1 / 60, style=RIGID)
    coverage = measure_coverage(database_of([SourceClip("circle", "circle", clip)]), SMALL)

    assert len(coverage.speed_m_s) == 541
    assert coverage.speed_m_s == pytest.approx(2.0, abs=1e-3)
    assert coverage.turn_rate_rad_s == pytest.approx(radians(50.0), abs=1e-3)
    # Near its ends a clip is smoothed from one side only.
    assert np.degrees(coverage.turn_rate_rad_s[30:-30]) == pytest.approx(50.0, abs=1e-3)
    assert coverage.strafe_m_s == pytest.approx(0.0, abs=0.02)  # the spine swings about the hips


def test_removing_what_no_trial_used_changes_no_bit_with_a_pinned_normaliser() -> None:
    clips = gait_clips(product((1.0, 2.0, 4.0), (-50.0, 0.0, 50.0, 300.0)), 6.0)
    database = database_of(clips)
    result = evaluated(database, SMALL)
    unused = {database.clips[at].uid for at, usage in enumerate(result.usage) if not usage.ticks}
    assert unused
    less = database_of([clip for clip in clips if clip.uid not in unused], normaliser=database.normaliser)
    again = evaluated(less, SMALL)

    assert again.provenance.dataset != result.provenance.dataset
    assert [one.metrics for one in again.trials] == [one.metrics for one in result.trials]
    for before, after in zip(result.records, again.records, strict=True):
        for name in ("positions", "headings", "match_cost", "continuing_cost", "pose_cost"):
            assert getattr(before, name).tobytes() == getattr(after, name).tobytes()


def test_a_database_that_looks_farther_than_a_second_ahead_sees_every_switch_that_comes() -> None:
    looking_far = DatabaseOptions(horizons_s=(1.0, 2.0, 3.0))
    database = database_of(gait_clips(product((1.0, 2.0, 4.0), (0.0, 50.0)), 6.0), looking_far)
    options = SMALL.replace(speeds_m_s=(1.0,), turn_rates_deg_s=(50.0,), families=("switching",), switch_every_s=1.0)
    (trial,) = suite_trials(options)
    index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)

    (record,) = run_suite(database, options)

    expected = run_trial(database, index, reference(trial, look_ahead_s=10.0), options.controller)
    assert np.array_equal(record.match_cost, expected.match_cost, equal_nan=True)
    assert record.rows.tolist() == expected.rows.tolist()


# The baseline


def test_the_baseline_owns_every_cell_and_both_speeds() -> None:
    baseline = evaluate_baseline(SMALL)

    assert baseline.coverage.index == 1.0
    assert {clip.name for clip in baseline.clips} >= {"v=4 w=-50", "v=1 w=0", "v=2 w=50"}
    assert baseline.notes == ()
    assert baseline.records == ()
    assert present(baseline.suite["circle.offset_mean"]) < 0.8


def test_the_baseline_is_the_same_whenever_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    first = evaluate_baseline(SMALL, threads=1)
    assert evaluate_baseline(SMALL) is first
    monkeypatch.setattr(suites, "_baselines", {})
    second = evaluate_baseline(SMALL, threads=2)

    assert second is not first
    assert second.provenance == first.provenance
    assert second.trials == first.trials
    assert second.suite == first.suite


def test_cells_that_nobody_can_walk_are_left_out_of_the_baseline_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def generate_slow_gait(speed_m_s: float, *arguments: float) -> Clip:
        if speed_m_s >= IMPOSSIBLE_M_S:
            raise MotionError("the legs are too short", code="gait-out-of-reach")
        return generate_gait(speed_m_s, *arguments)

    monkeypatch.setattr(suites, "generate_gait", generate_slow_gait)
    monkeypatch.setattr(suites, "_baselines", {})
    options = SMALL.replace(speeds_m_s=(2.0, IMPOSSIBLE_M_S), turn_rates_deg_s=(0.0,), families=("circle",))
    baseline = evaluate_baseline(options)

    assert [clip.name for clip in baseline.clips] == ["v=2 w=0"]
    assert baseline.notes[0].startswith(f"no generated clip for v={IMPOSSIBLE_M_S:g} w=0: ")


def test_an_evaluation_has_its_baseline_beside_it() -> None:
    database = database_of(gait_clips([(1.0, 0.0), (1.0, 50.0)], 6.0))
    told = []
    result = evaluate(database, SMALL, threads=2, progress=lambda done, total, _note: told.append(done / total))

    assert result.baseline is not None
    assert present(result.baseline.suite["offset_mean"]) < present(result.suite["offset_mean"])
    assert len(result.records) == len(result.trials) == 12
    assert told[-1] == 1.0
    assert evaluate(database, SMALL, with_baseline=False).baseline is None


def test_an_evaluation_tells_its_progress_over_all_runs_and_builds_one_index(monkeypatch: pytest.MonkeyPatch) -> None:
    database = database_of(gait_clips([(1.0, 0.0)], 4.0))
    options = SMALL.replace(
        speeds_m_s=(1.0,), turn_rates_deg_s=(0.0,), families=("circle",), duration_s=1.0, replicates=3
    )
    built, told = [], []

    def build(*arguments: Any) -> SearchIndex:
        built.append(len(arguments[0]))
        return build_index(*arguments)

    monkeypatch.setattr(copies, "build_index", build)
    monkeypatch.setattr(suites, "_baselines", {})

    evaluate(database, options, with_baseline=False, progress=lambda *news: told.append(news[:2]))
    assert built == [len(database.features)]
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    for _ in range(2):
        told.clear()
        evaluate(database, options, progress=lambda *news: told.append(news[:2]))
        assert told[:4] == [(0, 6), (1, 6), (2, 6), (3, 6)], "the baseline runs in three replicates, too"
        assert told[-1] == (6, 6)
