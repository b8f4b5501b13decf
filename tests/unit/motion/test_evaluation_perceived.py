"""Coverage of poses, planned removals and the reasons for them, computed with a perceptual metric."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.support.suggestion_cases import OPTIONS, evaluated

from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.improvement.filling import rank_fillings
from marey_motion.evaluation.improvement.lost_poses import LostPoses
from marey_motion.evaluation.improvement.suggest import suggest
from marey_motion.evaluation.improvement.suggestion_documents import suggestions_to_tree
from marey_motion.evaluation.perceived import PerceivedRows, indistinguishable
from marey_motion.evaluation.similarity import measure_similarity, source_of_rows, window_cells, window_rows
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.motion import Motion
from marey_motion.perception.maps import paired_distances
from marey_motion.perception.measuring import measure_motion
from marey_motion.perception.metric import metric_of
from marey_motion.rigs import map_joints
from marey_schemas.documents.metrics import MetricIdentity, built_in_metric
from marey_schemas.options.improvement import SuggestionOptions
from marey_schemas.options.matching import DatabaseOptions

PAPER = built_in_metric("published/positions-sigmoid")


@cache
def database() -> MatchingDatabase:
    """A walk, its copy, a slightly faster walk and a run."""
    walk = generate_gait(1.1, 0.0, 3.0)
    clips = {"a@1": walk, "b@1": walk, "c@1": generate_gait(1.2, 0.0, 3.0), "d@1": generate_gait(3.0, 0.0, 3.0)}
    body = MatchingBody.from_mapping(walk.skeleton, map_joints(walk.skeleton))
    return build_database([SourceClip(name, name, clip) for name, clip in clips.items()], body, DatabaseOptions())


def test_the_poses_of_a_cell_are_compared_by_the_metric() -> None:
    known = database()
    coverage = measure_coverage(known, OPTIONS)
    found = measure_similarity(known, coverage, 0.5, perceived_rows=PerceivedRows(known, PAPER))
    assert found.metric == MetricIdentity.of(PAPER)
    cell = int(np.argmax(found.frames))
    place = divmod(cell, found.frames.shape[1])
    rows = window_rows(known, coverage)[window_cells(coverage) == cell]
    measured = [
        measure_motion(
            Motion(poses[:, :3], poses[:, 3:].reshape(len(poses), -1, 4), np.zeros((len(poses), 0, 3)), ()),
            known.body,
            60.0,
        )
        for clip in known.clips
        for poses in [known.poses[clip.start : clip.stop].astype(np.float64)]
    ]
    clips, sources = known.clip_of_row[rows], source_of_rows(known)[rows]
    within = rows - np.array([known.clips[clip].start for clip in clips])
    nearest = []
    for number in range(0, len(rows), 20):
        one = measured[clips[number]].at(np.full(1, within[number], np.float64))
        others = [
            paired_distances(one, measured[clips[other]].at(np.full(1, within[other], np.float64)), metric_of(PAPER))[0]
            for other in np.flatnonzero(sources != sources[number])
        ]
        nearest.append(min(others))
    perceived_rows = PerceivedRows(known, PAPER)
    groups = source_of_rows(known)
    told = perceived_rows.nearest(rows[::20], groups[rows[::20]], perceived_rows, rows, groups[rows])
    np.testing.assert_allclose(told, nearest, atol=1e-9)
    whole = perceived_rows.nearest(rows, groups[rows], perceived_rows, rows, groups[rows])
    assert found.blendable_share[place] == np.mean(whole <= 0.5)
    assert found.distance[place] == np.median(whole)


def test_poses_are_lost_with_the_last_clip_that_has_them() -> None:
    known = database()
    lost = LostPoses(known, PerceivedRows(known, PAPER), 1e-6, most_poses=60)
    seconds = {clip.uid: clip.frame_count / 60 for clip in known.clips}
    assert lost.seconds([]) == lost.seconds(["b@1"]) == 0.0
    assert lost.replaced_share("b@1", []) == 1.0
    assert lost.replaced_share("b@1", ["a@1"]) == lost.replaced_share("d@1", []) == 0.0
    assert lost.seconds(["a@1", "b@1"]) == pytest.approx(seconds["a@1"] + seconds["b@1"])
    assert lost.seconds(["b@1", "d@1"]) == pytest.approx(seconds["d@1"])
    everything = LostPoses(known, PerceivedRows(known, PAPER), 1e6)
    assert everything.seconds(["a@1", "b@1", "c@1"]) == 0.0
    assert everything.seconds(list(seconds)) == pytest.approx(sum(seconds.values()))


def test_suggestions_use_the_metric_and_name_it() -> None:
    known = database()
    result = evaluated(known)
    options = SuggestionOptions(removals=2, duplicate_cm=20.0, lost_pose=100.0)
    outside = replace(known, clips=tuple(replace(clip, uid=f"x{clip.uid}") for clip in known.clips))
    found = suggest(known, result, collections={"others": outside}, options=options, metric=PAPER)
    perceived_rows = PerceivedRows(known, PAPER)
    expected = perceived_rows.transitions(result.switches).median or indistinguishable(PAPER)
    assert found.similarity.threshold == expected
    assert found.fillings == rank_fillings(
        known, result.coverage, {"others": outside}, result.options, expected, perceived_rows=perceived_rows
    )
    assert {one.blendable_share for one in found.fillings} <= {1.0}  # every pose is in the set
    lost = LostPoses(known, perceived_rows, expected)
    gone = {clip.source for clip in found.unused.clips}
    plain = suggest(known, result, options=options)
    harms = {one.source: one.harm for one in plain.redundant}
    assert found.redundant
    for one in found.redundant:
        assert one.lost_s is not None
        assert one.lost_s == pytest.approx(lost.seconds({*gone, one.source}) - lost.seconds(gone))
        assert one.harm == pytest.approx(harms[one.source] + 100.0 * one.lost_s)
    tree, without = suggestions_to_tree(found), suggestions_to_tree(plain)
    identity = MetricIdentity.of(PAPER).model_dump()
    assert tree["similarity"]["metric"] == tree["redundant"]["metric"] == tree["near_duplicates"]["metric"] == identity
    assert tree["similarity"]["threshold"] == expected
    assert all("look like poses of clips that remain" in one["reason"] for one in tree["redundant"]["clips"])
    assert any("perceptual distance 0.00, up to 0.16" in one["reason"] for one in tree["near_duplicates"]["spared"])
    assert "metric" not in without["similarity"]
    assert "lost_s" not in without["redundant"]["clips"][0]
    chosen = SuggestionOptions(removals=0, consider=0, blendable_distance=0.25)
    assert suggest(known, result, options=chosen, metric=PAPER).similarity.threshold == 0.25
