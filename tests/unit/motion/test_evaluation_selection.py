"""Selection of clips from a matching database: rows are copied from the whole database, not computed again."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.present import present
from tests.support.suggestion_cases import named, same_to_the_bit, simulated, wandering_tracks, with_mirrored
from tests.support.synthetic_databases import synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.selection import (
    clips_by_source,
    joined,
    rows_of_sources,
    same_skeleton,
    without_rows,
    without_sources,
)
from marey_motion.matching.database import MatchingDatabase

ROWS = ("features", "selectable", "root_positions", "root_headings", "pose_points", "poses", "contacts")


def assert_equal(one: MatchingDatabase, other: MatchingDatabase) -> None:
    assert one.clips == other.clips
    for name in ROWS:
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_a_database_without_clips_is_the_one_made_without_them() -> None:
    tracks = wandering_tracks()
    whole = synthetic_database(tracks)
    expected = synthetic_database([*tracks[:2], *tracks[3:]], normaliser=whole.normaliser)
    assert_equal(without_sources(whole, ["clip_002"]), expected)


def test_a_clip_goes_with_its_mirrored_copy() -> None:
    tracks = wandering_tracks(3)
    whole = with_mirrored(tracks)
    assert clips_by_source(whole.clips)["clip_001"] == (2, 3)
    assert [clip.uid for clip in without_sources(whole, ["clip_001"]).clips if "clip" in clip.uid] == [
        "clip_000",
        "clip_000~mirrored",
        "clip_002",
        "clip_002~mirrored",
    ]


def test_two_databases_joined_are_the_one_made_of_all_clips() -> None:
    tracks = wandering_tracks()
    whole = synthetic_database(tracks)
    first, second = (synthetic_database(tracks[start::2], normaliser=whole.normaliser) for start in (0, 1))
    assert_equal(joined(first, second), whole)
    assert joined(first, synthetic_database(tracks[1::2])).normaliser is first.normaliser


def test_a_clip_without_translations_joins_one_that_has_them_by_its_offsets() -> None:
    tracks = wandering_tracks()
    first, second = synthetic_database(tracks[:2]), synthetic_database(tracks[2:])
    moved = np.random.default_rng(0).normal(size=(second.row_count, 1, 3)).astype(np.float32)
    both = joined(first, replace(second, translations=moved, translated_joints=(4,)))
    assert both.translated_joints == (4,)
    assert np.array_equal(present(both.translations)[first.row_count :], moved)
    assert np.allclose(present(both.translations)[: first.row_count], first.body.skeleton.offsets[4], atol=1e-7)


def test_rows_taken_out_of_a_clip_leave_two_clips_that_end_where_they_were() -> None:
    database = synthetic_database(named(wandering_tracks()[:3]))
    clip = database.clips[1]
    removed = np.zeros(database.row_count, dtype=bool)
    removed[clip.start + 40 : clip.start + 90] = True
    less = without_rows(database, removed)
    frames = clip.frame_count
    assert [one.uid for one in less.clips] == ["clip_000", "clip_001#0-40", f"clip_001#90-{frames}", "clip_002"]
    assert less.row_count == database.row_count - 50
    assert np.array_equal(less.features, database.features[~removed])
    assert not less.selectable[less.clips[1].stop - 1]
    assert less.root_motion.successors[less.clips[1].stop - 1] < 0


def test_taking_nothing_away_changes_no_trial() -> None:
    database = synthetic_database(wandering_tracks(4))
    same = without_rows(database, np.zeros(database.row_count, dtype=bool))
    assert same_to_the_bit(database, simulated(database), same, simulated(same))


def test_what_does_not_belong_together_is_refused() -> None:
    tracks = wandering_tracks()
    database = synthetic_database(tracks)
    with pytest.raises(MotionError, match="no clip nobody"):
        rows_of_sources(database.clips, ["nobody"])
    with pytest.raises(MotionError, match="no clip is left in the database"):
        without_sources(database, list(clips_by_source(database.clips)))
    with pytest.raises(MotionError, match="both databases contain the clip clip_000"):
        joined(database, synthetic_database(tracks[:1]))
    with pytest.raises(MotionError, match="same options"):
        joined(database, replace(database, options=database.options.replace(end_policy="trim")))
    skeleton = replace(database.body.skeleton, offsets=database.body.skeleton.offsets * 1.1)
    other = replace(database, body=replace(database.body, skeleton=skeleton))
    assert same_skeleton(database, database)
    assert not same_skeleton(database, other)
    with pytest.raises(MotionError, match="retarget"):
        joined(database, other)
