"""Ranking of clips from other collections by the coverage gaps that they fill.

The set must be able to blend with them.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.present import present
from tests.support.suggestion_cases import OPTIONS, evaluated, named, with_mirrored
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.improvement.filling import plan_fillings, rank_fillings
from marey_motion.evaluation.improvement.selection import joined, without_sources
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.matching.database import MatchingDatabase

THRESHOLD = 1.5


def straight_set() -> MatchingDatabase:
    """Return a database of straight walks at both speeds of the grid, without turns."""
    return synthetic_database(named([arc_track(1.0, 0.0, 6.0), arc_track(2.0, 0.0, 6.0)]))


def others(**tracks: Any) -> MatchingDatabase:
    return synthetic_database([track._replace(uid=uid) for uid, track in sorted(tracks.items())])


def ranked(database: MatchingDatabase, **collections: Any) -> tuple[Any, ...]:
    coverage = measure_coverage(database, OPTIONS)
    return rank_fillings(database, coverage, collections, OPTIONS, THRESHOLD)


def test_the_clip_that_fills_a_hole_comes_first_and_what_fills_none_is_left_out() -> None:
    outside = others(
        left=arc_track(1.0, 50.0, 4.0), short_left=arc_track(1.0, 50.0, 1.5), straight=arc_track(1.0, 0.0, 9.0)
    )
    found = ranked(straight_set(), outside=outside)
    assert [filling.source for filling in found] == ["left", "short_left"]
    (cell,) = found[0].cells
    assert (cell.speed_m_s, cell.turn_rate_deg_s) == (1.0, 50.0)
    assert cell.filled_s == cell.deficit_s == found[0].filled_s == 1.0
    assert found[1].filled_s == pytest.approx(0.5)


def test_the_predicted_index_is_that_of_the_set_with_the_clip() -> None:
    database, outside = straight_set(), others(left=arc_track(1.0, 50.0, 4.0), right=arc_track(2.0, -50.0, 4.0))
    for filling in ranked(database, outside=outside):
        rest = [clip.uid for clip in outside.clips if clip.uid != filling.source]
        union = joined(database, without_sources(outside, rest))
        assert filling.coverage_index == measure_coverage(union, OPTIONS).index


def test_the_better_blendable_of_two_clips_that_fill_alike_comes_first() -> None:
    turn = arc_track(1.0, 50.0, 4.0)
    outside = others(alien=turn._replace(pose=turn.pose + 3.0), kindred=turn)
    kindred, alien = ranked(straight_set(), outside=outside)
    assert (kindred.source, kindred.blendable_share) == ("kindred", 1.0)
    assert (alien.source, alien.blendable_share, alien.score) == ("alien", 0.0, 0.0)


def test_a_cell_that_is_filled_to_the_last_frame_is_full_however_its_seconds_are_rounded() -> None:
    turn = arc_track(1.0, 50.0, 4.0)
    names = ("positions", "headings", "pose")
    part, rest = (turn._replace(**{name: getattr(turn, name)[:frames] for name in names}) for frames in (80, 100))
    assert 1.0 - 20 / 60 > 40 / 60
    database = synthetic_database(named([arc_track(1.0, 0.0, 6.0), arc_track(2.0, 0.0, 6.0), part]))
    outside = others(rest=rest)
    (filling,) = ranked(database, outside=outside)
    coverage = measure_coverage(database, OPTIONS)
    (step,) = plan_fillings([filling], coverage, {"outside": outside}, OPTIONS)
    assert filling.coverage_index == step.coverage_index == measure_coverage(joined(database, outside), OPTIONS).index
    assert filling.coverage_index == pytest.approx(coverage.index + 1 / 6)


def test_only_the_frames_that_fill_holes_are_asked_whether_they_can_be_blended() -> None:
    ahead, turn = arc_track(1.0, 0.0, 3.0), arc_track(1.0, 50.0, 3.0)
    pose = np.concatenate((ahead.pose, turn.pose))
    pose[:120] += 3.0  # like nothing in the set, where there is enough already
    both = turn._replace(
        positions=np.concatenate((ahead.positions, turn.positions + np.array((0.0, 3.0)))),
        headings=np.concatenate((ahead.headings, turn.headings)),
        pose=pose,
    )
    (filling,) = ranked(straight_set(), outside=others(both=both))
    assert [(cell.speed_m_s, cell.turn_rate_deg_s) for cell in filling.cells] == [(1.0, 50.0)]
    assert filling.blendable_share == 1.0


def test_clips_of_another_skeleton_need_a_retarget_and_come_last() -> None:
    outside = others(left=arc_track(1.0, 50.0, 4.0))
    skeleton = replace(outside.body.skeleton, offsets=outside.body.skeleton.offsets * 1.2)
    foreign = others(foreign_left=arc_track(1.0, 50.0, 4.0), foreign_right=arc_track(2.0, -50.0, 4.0))
    foreign = replace(foreign, body=replace(foreign.body, skeleton=skeleton))
    found = ranked(straight_set(), foreign=foreign, outside=outside)
    assert [filling.source for filling in found] == ["left", "foreign_left", "foreign_right"]
    assert [filling.needs_retarget for filling in found] == [False, True, True]
    assert found[1].blendable_share is None
    assert found[1].score is None


def test_clips_that_the_set_has_already_are_no_candidates() -> None:
    turn = arc_track(1.0, 50.0, 1.5)
    database = synthetic_database([arc_track(1.0, 0.0, 6.0, uid="a"), turn._replace(uid="left")])
    assert ranked(database, outside=others(left=turn)) == ()


def test_a_plan_adds_what_the_earlier_additions_leave_open() -> None:
    outside = others(
        left_long=arc_track(1.0, 50.0, 4.0), left_too=arc_track(1.0, 50.0, 3.0), right=arc_track(1.0, -50.0, 1.6)
    )
    database = straight_set()
    coverage = measure_coverage(database, OPTIONS)
    found = rank_fillings(database, coverage, {"outside": outside}, OPTIONS, THRESHOLD)
    plan = plan_fillings(found, coverage, {"outside": outside}, OPTIONS)
    assert [step.filling.source for step in plan] == ["left_long", "right"]
    union = joined(database, without_sources(outside, ["left_too"]))
    assert plan[-1].coverage_index == measure_coverage(union, OPTIONS).index
    assert plan[1].filled_s == pytest.approx(0.6)


def test_a_mirrored_collection_fills_both_sides() -> None:
    outside = with_mirrored([arc_track(1.0, 50.0, 4.0, uid="left")])
    (filling,) = ranked(with_mirrored(named([arc_track(1.0, 0.0, 6.0), arc_track(2.0, 0.0, 6.0)])), outside=outside)
    assert {cell.turn_rate_deg_s for cell in filling.cells} == {-50.0, 50.0}
    assert filling.filled_s == 2.0


def test_adding_what_fills_a_hole_improves_the_trials_of_its_cells() -> None:
    database = straight_set()
    outside = others(left=arc_track(1.0, 50.0, 8.0), right=arc_track(1.0, -50.0, 8.0))
    before, after = evaluated(database), evaluated(joined(database, outside))
    for one, other in zip(before.trials, after.trials, strict=True):
        if one.trial.speed_m_s == 1.0 and one.trial.turn_rate_rad_s != 0.0:
            assert present(other.metrics["offset_mean"]) < 0.5 * present(one.metrics["offset_mean"])


def test_only_so_many_frames_of_a_long_clip_are_compared() -> None:
    database, outside = straight_set(), others(left=arc_track(1.0, 50.0, 20.0))
    coverage = measure_coverage(database, OPTIONS)
    (few,) = rank_fillings(database, coverage, {"outside": outside}, OPTIONS, THRESHOLD, most_frames=50)
    (many,) = rank_fillings(database, coverage, {"outside": outside}, OPTIONS, THRESHOLD, most_frames=10_000)
    assert 25 <= few.measured <= 50
    assert many.measured == np.sum(measure_coverage(outside, OPTIONS).turn_rate_rad_s > 0)


def test_the_search_can_be_stopped() -> None:
    database = straight_set()
    coverage = measure_coverage(database, OPTIONS)
    with pytest.raises(EvaluationCancelled):
        rank_fillings(
            database,
            coverage,
            {"outside": others(left=arc_track(1.0, 50.0, 4.0))},
            OPTIONS,
            THRESHOLD,
            cancelled=lambda: True,
        )
