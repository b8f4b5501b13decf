"""Similarity of the poses in a cell of speed and turn rate, compared with the distances of all pairs of frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.suggestion_cases import OPTIONS, evaluated, named, wandering_tracks, with_mirrored
from tests.support.synthetic_databases import Track, arc_track, synthetic_database

from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.evaluation.similarity import (
    accepted_distance,
    measure_similarity,
    nearest_poses,
    source_of_rows,
    window_cells,
    window_rows,
)
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import Status


def straight_walks(count: int = 3, seconds: float = 5.0, **given: Any) -> list[Track]:
    """Return clips that have one speed, and so are in one cell, but differ in the phase of the gait."""
    return named([arc_track(1.0, 0.0, seconds, phase=0.4 * number, **given) for number in range(count)])


def brute_force(database: MatchingDatabase, rows: Ints) -> Floats:
    """Return for each of these rows the distance to the nearest row from another source."""
    points = database.pose_points[rows].astype(np.float64)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1).sum(axis=-1)
    sources = source_of_rows(database)[rows]
    apart[sources[:, None] == sources[None]] = np.inf
    return apart.min(axis=1)


def test_the_nearest_pose_of_another_clip_is_found_for_every_frame() -> None:
    database = synthetic_database(wandering_tracks())
    coverage = measure_coverage(database, OPTIONS)
    rows = np.unique(window_rows(database, coverage))[::3]
    sources = source_of_rows(database)[rows]
    points = database.pose_points[rows]
    assert np.allclose(nearest_poses(points, sources, points, sources), brute_force(database, rows), rtol=1e-12)


def test_each_cell_is_measured_by_its_own_frames_alone() -> None:
    database = synthetic_database(wandering_tracks(12))
    coverage = measure_coverage(database, OPTIONS)
    found = measure_similarity(database, coverage, threshold=4.0)
    rows, cells = window_rows(database, coverage), window_cells(coverage)
    assert len(np.unique(cells[cells >= 0])) > 2
    for cell in np.unique(cells[cells >= 0]).tolist():
        own = rows[cells == cell]
        place = divmod(cell, found.frames.shape[1])
        distances = brute_force(database, own)
        assert found.frames[place] == found.measured[place] == len(own)
        assert found.sources[place] == len(np.unique(source_of_rows(database)[own]))
        assert found.blendable_share[place] == np.mean(distances <= 4.0)
        if found.sources[place] > 1:
            assert found.distance[place] == pytest.approx(np.median(distances))
        else:
            assert np.isnan(found.distance[place])
            assert found.blendable_share[place] == 0.0
    assert np.isnan(found.blendable_share[found.frames == 0]).all()


def test_a_window_belongs_to_the_frame_it_begins_with() -> None:
    database = synthetic_database(named([arc_track(1.0, 0.0, 3.0), arc_track(2.0, 50.0, 4.0)]))
    rows = window_rows(database, measure_coverage(database, OPTIONS))
    assert rows.tolist() == [*range(120), *range(180, 180 + 180)]


def test_frames_within_the_threshold_are_counted_as_blendable() -> None:
    database = synthetic_database(straight_walks())
    coverage = measure_coverage(database, OPTIONS)
    cell = np.unravel_index(np.argmax(coverage.seconds), coverage.seconds.shape)
    assert measure_similarity(database, coverage, threshold=1e3).blendable_share[cell] == 1.0
    assert measure_similarity(database, coverage, threshold=1e-9).blendable_share[cell] == 0.0
    middle = measure_similarity(database, coverage, threshold=1.0).distance[cell]
    assert measure_similarity(database, coverage, threshold=middle).blendable_share[cell] == pytest.approx(
        0.5, abs=0.02
    )


def test_a_cell_with_one_clip_has_nothing_to_blend_with_and_neither_has_its_mirrored_copy() -> None:
    alone = synthetic_database(straight_walks(1))
    twins = with_mirrored(straight_walks(1))
    for database in (alone, twins):
        found = measure_similarity(database, measure_coverage(database, OPTIONS), threshold=1e3)
        assert found.share == 0.0
        assert np.isnan(found.distance).all()


def test_dense_data_that_does_not_meet_is_told_from_data_that_does() -> None:
    near = straight_walks(2)
    far = [near[0], near[1]._replace(pose=near[1].pose + 2.0)]
    threshold = 1.5
    shares = []
    for tracks in (near, far):
        database = synthetic_database(tracks)
        shares.append(measure_similarity(database, measure_coverage(database, OPTIONS), threshold).share)
    assert shares[0] == 1.0
    assert shares[1] == 0.0


def test_of_a_huge_cell_evenly_chosen_frames_are_measured_against_all() -> None:
    database = synthetic_database(straight_walks(3))
    coverage = measure_coverage(database, OPTIONS)
    few, all_frames = (measure_similarity(database, coverage, 1.0, most_frames=most) for most in (100, 10_000))
    cell = np.unravel_index(np.argmax(all_frames.frames), all_frames.frames.shape)
    assert few.frames[cell] == all_frames.frames[cell] > 100
    assert 50 <= few.measured[cell] <= 100
    own = window_rows(database, coverage)[window_cells(coverage) == np.ravel_multi_index(cell, few.frames.shape)]
    step = -(-len(own) // 100)
    assert few.blendable_share[cell] == np.mean(brute_force(database, own)[::step] <= 1.0)


def test_the_usual_threshold_is_the_median_cost_of_the_switches_that_were_made() -> None:
    result = evaluated(synthetic_database(wandering_tracks()))
    costs = [
        record.pose_cost[tick - 1]
        for record in result.records
        for tick in range(1, len(record.rows))
        if record.status[tick] == Status.REPLACING
    ]
    assert accepted_distance(result.records) == np.median(costs)
    still = [replace(record, status=np.zeros_like(record.status)) for record in result.records]
    assert accepted_distance(still) is None


def test_thresholds_that_are_no_distance_are_refused_and_the_work_can_be_stopped() -> None:
    database = synthetic_database(straight_walks())
    coverage = measure_coverage(database, OPTIONS)
    with pytest.raises(MotionError, match="threshold"):
        measure_similarity(database, coverage, 0.0)
    with pytest.raises(EvaluationCancelled):
        measure_similarity(database, coverage, 1.0, cancelled=lambda: True)
