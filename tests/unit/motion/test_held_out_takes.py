"""The paths of real takes as trials, each without the take itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.support.judged_sets import database_of, walks
from tests.support.suggestion_cases import OPTIONS, named, places
from tests.support.synthetic_databases import Track, arc_track, mirrored_track, random_tracks, synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.held_out import index_for, pose_errors, take_trials
from marey_motion.evaluation.judgement import judge_trial
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import result_from_tree, result_to_tree
from marey_motion.evaluation.scenario import Trial, demand, reference, suite_trials
from marey_motion.evaluation.suite import evaluate
from marey_motion.matching.copies import index_of
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord

TAKES = OPTIONS.replace(families=("takes",), duration_s=5.0, approach_s=1.0, replicates=2)
LEFT = arc_track(2.0, 50.0, 9.0, uid="left")


def moved(track: Track, uid: str) -> Track:
    """Return the same motion, recorded elsewhere in another direction, so that its rows differ by rounding."""
    turned = np.stack((track.positions[:, 1], -track.positions[:, 0]), axis=1) + np.array([3.0, -7.0])
    return track._replace(uid=uid, positions=turned, headings=track.headings + np.pi / 2)


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    clips = [
        LEFT,
        moved(LEFT, "left again"),
        *named(random_tracks(5, seed=2)),
        arc_track(0.0, 0.0, 9.0, uid="standing"),
    ]
    return synthetic_database(clips)


@pytest.fixture(scope="module")
def result(database: MatchingDatabase) -> EvaluationResult:
    return evaluate(database, TAKES, threads=1)


def test_the_path_of_a_clip_is_asked_for_after_a_straight_approach(database: MatchingDatabase) -> None:
    trial = next(one for one in take_trials(database, TAKES) if one.left_out == "left")
    assert (trial.name, demand(trial)) == ("takes left", "path of “left”, which is left out")
    assert trial.speed_m_s == pytest.approx(2.0, rel=2e-3)
    asked = reference(trial)
    assert asked.tick_count == 6 * 60
    assert asked.positions[60] == pytest.approx((0.0, 2.0), abs=1e-2)
    radius, angle = 2.0 / np.radians(50.0), np.radians(50.0) * 4.0
    there = np.array([radius * (1 - np.cos(angle)), 2.0 + radius * np.sin(angle)])
    assert asked.positions[300] == pytest.approx(there, abs=2e-2)
    assert asked.headings[300] == pytest.approx(angle, abs=1e-6)
    assert asked.speeds_m_s[60:330] == pytest.approx(2.0, abs=2e-2)
    assert np.degrees(asked.turn_rates_rad_s[60:330]) == pytest.approx(50.0, abs=0.5)


def test_no_trial_shows_the_clip_that_it_leaves_out(database: MatchingDatabase, result: EvaluationResult) -> None:
    assert len(result.trials) > 2
    for one, record in zip(result.trials, result.records, strict=True):
        assert one.trial.left_out not in {uid for uid, _ in places(database, record.rows)}
    assert "standing" not in {one.trial.left_out for one in result.trials}
    assert result.baseline is None


def test_a_path_of_which_the_set_has_another_take_is_followed_best(result: EvaluationResult) -> None:
    offsets = {one.trial.left_out: one.metrics["offset_mean"] or 0.0 for one in result.trials}
    others = [offset for source, offset in offsets.items() if not source.startswith("left")]
    assert max(offsets["left"], offsets["left again"]) < min(others)
    assert {judge_trial(one, TAKES.limits).region for one in result.trials} == {"real paths"}


def played(trial: Trial, rows: np.ndarray) -> TrialRecord:
    """Return the record of a character that displays these rows while it follows the path of a trial exactly."""
    asked, count = reference(trial), len(rows)
    nothing = np.full(count, np.nan)
    return TrialRecord(
        60.0, rows.astype(np.int32), asked.positions[:count], asked.headings[:count],
        np.zeros(count, np.int8), nothing, nothing, nothing,
    )  # fmt: skip


def test_pose_errors_are_distances_from_the_poses_of_the_left_out_take() -> None:
    gaits = database_of(walks(seconds=6.0)[:2])
    options = TAKES.replace(approach_s=0.0, duration_s=3.0)
    trial = take_trials(gaits, options)[0]
    ticks = np.arange(reference(trial).tick_count)
    window = ticks[1:] >= 30

    def errors(rows: np.ndarray, counted: np.ndarray = window) -> dict[str, float | None]:
        return pose_errors(gaits, options.controller, trial, played(trial, rows), counted)

    names = ("pose_error_mean", "pose_error_p95", "pose_error_nearest")
    assert errors(ticks) == pytest.approx(dict.fromkeys(names, 0.0), abs=1e-5)
    later = errors(ticks + 20)
    points = gaits.pose_points.astype(np.float64)
    apart = np.linalg.norm(points[ticks[30:] + 20] - points[ticks[30:]], axis=-1).mean(axis=-1)
    assert later["pose_error_mean"] == pytest.approx(apart.mean(), abs=1e-5)
    assert later["pose_error_p95"] == pytest.approx(np.percentile(apart, 95), abs=1e-5)
    assert apart.mean() > 0.05
    assert later["pose_error_nearest"] == pytest.approx(0.0, abs=1e-5), "the take has the same pose a little later"
    assert errors(ticks, np.full(len(window), False)) == dict.fromkeys(names)
    assert pose_errors(gaits, options.controller, suite_trials(OPTIONS)[0], played(trial, ticks), window) == {}


def test_evaluations_along_takes_have_pose_errors() -> None:
    gaits = database_of([*walks(seconds=6.0)[1:3], *walks(seconds=7.0)[1:2]])
    options = TAKES.replace(duration_s=3.0, families=("circle", "takes"))
    found = evaluate(gaits, options, threads=1, with_baseline=False)
    errors = {one.trial.left_out: one.metrics["pose_error_nearest"] for one in found.trials if one.trial.left_out}
    assert max(errors["clip-000"] or 9.9, errors["clip-002"] or 9.9) < 0.02, "another take has the same poses"
    assert (errors["clip-001"] or 0.0) > 0.02
    assert found.suite["takes.pose_error_mean"] == found.suite["pose_error_mean"]
    assert "circle.pose_error_mean" not in found.suite


def test_equal_and_mirrored_clips_are_left_out_with_the_take() -> None:
    tracks = [LEFT, LEFT._replace(uid="copy"), mirrored_track(LEFT)._replace(uid="right"), *named(random_tracks(2, 4))]
    pool = synthetic_database(tracks)
    index, trials = index_of(pool), {one.left_out: one for one in take_trials(pool, TAKES)}
    own = index_for(pool, index, trials["left"])
    by_clip = {clip.uid: bool(own.selectable[clip.start : clip.stop].any()) for clip in pool.clips}
    assert by_clip == {"left": False, "copy": False, "right": True, "clip_000": True, "clip_001": True}
    circle = suite_trials(OPTIONS)[0]
    assert index_for(pool, index, circle) is index


def test_takes_are_chosen_evenly_and_refused_if_there_are_none(database: MatchingDatabase) -> None:
    every = [one.left_out for one in take_trials(database, TAKES)]
    few = [one.left_out for one in take_trials(database, TAKES.replace(most_takes=2))]
    assert few == [every[0], every[-1]]
    assert take_trials(database, OPTIONS) == ()
    for clips in ([LEFT], [arc_track(0.0, 0.0, 9.0, uid="one"), arc_track(2.0, 0.0, 2.0, uid="two")]):
        with pytest.raises(MotionError, match="trials along takes need two different clips"):
            take_trials(synthetic_database(clips), TAKES)


def with_copies(tracks: list[Track], *copies: str) -> MatchingDatabase:
    """Return a database in which the clips `copies`, such as `left~`, are mirrored copies of clips such as `left`."""
    pool = synthetic_database(tracks)
    clips = tuple(
        replace(clip, mirrored_from=clip.uid.partition("~")[0]) if clip.uid in copies else clip for clip in pool.clips
    )
    return replace(pool, clips=clips)


def test_a_set_of_mirrored_copies_alone_has_takes() -> None:
    wide = arc_track(2.0, 20.0, 9.0, uid="wide~")
    pool = with_copies([mirrored_track(LEFT)._replace(uid="left~"), wide], "left~", "wide~")
    trials = take_trials(pool, TAKES)
    assert [one.left_out for one in trials] == ["left", "wide"]
    for one in trials:
        assert index_for(pool, index_of(pool), one).selectable.any()


def test_the_mirrored_copy_of_the_only_clip_is_no_other_clip() -> None:
    pool = with_copies([LEFT, mirrored_track(LEFT)._replace(uid="left~")], "left~")
    with pytest.raises(MotionError, match="need two different clips"):
        take_trials(pool, TAKES)


def test_trials_along_takes_travel_in_documents(result: EvaluationResult) -> None:
    tree = json.loads(json.dumps(result_to_tree(result)["trials"], default=np.ndarray.tolist))
    again = result_from_tree({**result_to_tree(result), "trials": tree})
    assert [one.trial for one in again.trials] == [one.trial for one in result.trials]
