"""Search for clips with nearly the same motion."""

from dataclasses import replace
from math import radians
from typing import Any

import numpy as np
import pytest
from tests.support.suggestion_cases import named, wandering_tracks
from tests.support.synthetic_databases import synthetic_database

from marey_motion.alignment.dtw import warped_distance
from marey_motion.clip import Clip
from marey_motion.evaluation.improvement.duplicates import find_near_duplicates, frame_points, spared_sources
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.gait import generate_gait
from marey_motion.gait.style import GaitStyle
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.mirroring import mirror_clip
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import DatabaseOptions, Mirroring


def gaits(mirroring: Mirroring = "none", **clips: Any) -> MatchingDatabase:
    skeleton = next(iter(clips.values())).skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    sources = [SourceClip(uid, uid, clip, content=f"sha256:{uid}") for uid, clip in clips.items()]
    return build_database(sources, body, DatabaseOptions(mirroring=mirroring))


def walk(speed: float = 1.3, turn_deg: float = 0.0, seconds: float = 4.0, seed: int | None = None) -> Clip:
    return generate_gait(speed, radians(turn_deg), seconds, style=None if seed is None else GaitStyle.varied(seed))


def pairs_of(database: MatchingDatabase, threshold_cm: float = 3.0) -> set[tuple[str, str]]:
    found = find_near_duplicates(database, threshold_cm=threshold_cm)
    return {(pair.first, pair.second) for pair in found.pairs}


def test_the_same_walk_at_nearly_the_same_speed_is_a_near_duplicate_and_other_walks_are_not() -> None:
    database = gaits(
        walk=walk(),
        again=walk(1.31),
        faster=walk(1.6),
        turning=walk(1.3, 25.0),
        left=walk(1.3, 60.0),
        right=walk(1.3, -60.0),
        shorter=walk(seconds=2.5),
        somebody=walk(seed=5),
    )
    assert pairs_of(database, threshold_cm=1.5) == {("again", "walk")}


def test_a_copy_that_begins_elsewhere_on_the_ground_and_heads_elsewhere_is_found() -> None:
    database = gaits(walk=walk(), turned=walk(), other=walk(2.0))
    assert pairs_of(database, threshold_cm=0.01) == {("turned", "walk")}


def test_a_mirror_image_counts_only_where_clips_are_mirrored() -> None:
    left = walk(1.2, 50.0)
    skeleton = left.skeleton
    image = mirror_clip(left, MatchingBody.from_mapping(skeleton, map_joints(skeleton)).partners)
    assert pairs_of(gaits(left=left, right=image)) == set()
    (pair,) = find_near_duplicates(gaits("add", left=left, right=image), threshold_cm=3.0).pairs
    assert pair.mirrored
    assert pair.distance_cm < 0.01


def test_no_pair_within_the_threshold_is_passed_over() -> None:
    database = synthetic_database(named(wandering_tracks(10)[:10]))
    points = frame_points(database)
    clips = database.clips
    distances = {
        (one.uid, other.uid): 100 * warped_distance(points[one.start : one.stop], points[other.start : other.stop])
        for number, one in enumerate(clips)
        for other in clips[number + 1 :]
    }
    threshold = float(np.median(list(distances.values())))
    found = find_near_duplicates(database, threshold_cm=threshold)
    expected = {pair: distance for pair, distance in distances.items() if distance <= threshold}
    assert {(pair.first, pair.second): pair.distance_cm for pair in found.pairs} == pytest.approx(expected)
    assert found.compared == len(distances)
    assert [pair.distance_cm for pair in found.pairs] == sorted(expected.values())


def test_equal_documents_are_told_apart_from_others_that_are_alike() -> None:
    tracks = named(wandering_tracks()[:3])
    database = synthetic_database([*tracks, tracks[0]._replace(uid="copy"), tracks[1]._replace(uid="other_take")])
    contents = {"clip_000": "a", "copy": "a", "clip_001": "b", "other_take": "c"}
    clips = tuple(replace(clip, content=contents.get(clip.uid, "")) for clip in database.clips)
    found = find_near_duplicates(replace(database, clips=clips), threshold_cm=0.1)
    assert {(pair.first, pair.second): (pair.distance_cm, pair.same_content) for pair in found.pairs} == {
        ("clip_000", "copy"): (0.0, True),
        ("clip_001", "other_take"): (0.0, False),
    }


def test_of_each_pair_the_clip_that_is_used_less_goes_and_no_pair_is_left() -> None:
    tracks = named(wandering_tracks()[:2])
    copies = [tracks[0]._replace(uid="copy_1"), tracks[0]._replace(uid="copy_2")]
    database = synthetic_database([*tracks, *copies])
    found = find_near_duplicates(database, threshold_cm=0.1)
    gone = dict(spared_sources(database, found, {"clip_000": 5, "copy_1": 90, "copy_2": 5}))
    assert set(gone) == {"clip_000", "copy_2"}


def test_of_two_clips_used_alike_the_shorter_goes_and_of_two_as_long_that_of_the_higher_uid() -> None:
    track = named(wandering_tracks()[:1])[0]
    cut = track._replace(positions=track.positions[1:], headings=track.headings[1:], pose=track.pose[1:])
    for other, gone in ((track, "clip_001"), (cut, "clip_000")):
        database = synthetic_database([(track if other is track else cut), (track._replace(uid="clip_001"))])
        found = find_near_duplicates(database, threshold_cm=20.0)
        assert [uid for uid, _ in spared_sources(database, found, {})] == [gone]


def test_the_search_can_be_stopped_and_tells_its_progress() -> None:
    database = synthetic_database(named(wandering_tracks()[:4]))
    told = []
    find_near_duplicates(database, threshold_cm=3.0, progress=lambda *step: told.append(step))
    assert [step[:2] for step in told] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    with pytest.raises(EvaluationCancelled):
        find_near_duplicates(database, threshold_cm=3.0, cancelled=lambda: True)
