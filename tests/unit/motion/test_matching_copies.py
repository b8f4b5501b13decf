"""Clips that are twice in a set change no motion, whatever searches may not choose, and the order of clips does not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.suggestion_cases import OPTIONS, places, same_to_the_bit, wandering_tracks
from tests.support.synthetic_databases import synthetic_database

from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.selection import without_sources
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import run_suite
from marey_motion.matching.copies import equal_clips, searchable
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord
from marey_schemas.options.matching import ControllerOptions

BARRING = OPTIONS.replace(controller=ControllerOptions())
"""Searches may not choose frames near the displayed one, as by default."""
TRACKS = wandering_tracks()


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return synthetic_database(TRACKS)


@pytest.fixture(scope="module")
def doubled(database: MatchingDatabase) -> MatchingDatabase:
    """The same clips, of which the first six are there twice; their copies come last, or first."""
    later = [track._replace(uid=f"~{track.uid}") for track in TRACKS[:3]]
    earlier = [track._replace(uid=f"!{track.uid}") for track in TRACKS[3:6]]
    return synthetic_database([*earlier, *TRACKS, *later], normaliser=database.normaliser)


def runs(database: MatchingDatabase) -> list[TrialRecord]:
    return run_suite(database, BARRING, trials=suite_trials(BARRING))


def test_copies_are_found_and_only_the_first_clip_of_its_kind_is_searched(doubled: MatchingDatabase) -> None:
    assert equal_clips(doubled).tolist() == [0, 1, 2, 3, 4, 5, 0, 1, 2, *range(9, 13), 3, 4, 5]
    searched = searchable(doubled)
    by_clip = [bool(searched[clip.start : clip.stop].any()) for clip in doubled.clips]
    assert by_clip == [True] * 6 + [False] * 3 + [True] * 4 + [False] * 3
    assert np.array_equal(searchable(doubled, np.zeros(doubled.row_count, bool)), searched)


def test_copies_change_no_trial_even_if_frames_near_the_displayed_one_are_barred(
    database: MatchingDatabase, doubled: MatchingDatabase
) -> None:
    alone, again = runs(database), runs(doubled)
    for one, other in zip(alone, again, strict=True):
        for name in ("positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
        shown = [(uid.lstrip("!"), frame) for uid, frame in places(doubled, other.rows)]
        assert shown == places(database, one.rows)


def test_if_the_first_of_two_equal_clips_is_removed_the_copy_takes_its_place(doubled: MatchingDatabase) -> None:
    simulation = Resimulation(doubled, BARRING)
    shown = simulation.needed() & {f"!{track.uid}" for track in TRACKS[3:6]}
    assert shown, "some of the clips with a copy are used"
    removed = sorted(shown)
    assert simulation.results(removed) == simulation.results()
    assert {uid.removeprefix("!") for uid in removed} <= simulation.needed(removed)
    fresh = Resimulation(without_sources(doubled, removed), BARRING)
    assert fresh.results() == simulation.results(removed)


def test_a_loop_is_no_copy_of_the_same_clip_that_ends(doubled: MatchingDatabase) -> None:
    clips = tuple(replace(clip, loop=clip.uid.startswith("~")) for clip in doubled.clips)
    assert equal_clips(replace(doubled, clips=clips)).tolist()[-3:] == [13, 14, 15]


def test_the_order_of_the_clips_changes_no_trial(database: MatchingDatabase) -> None:
    order = np.random.default_rng(2).permutation(len(TRACKS)).tolist()
    shuffled = synthetic_database([TRACKS[number] for number in order], normaliser=database.normaliser)
    assert same_to_the_bit(database, runs(database), shuffled, runs(shuffled))
