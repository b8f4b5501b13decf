"""Removal of unused ranges of frames, which changes no trial."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.suggestion_cases import (
    OPTIONS,
    UNWANTED,
    named,
    same_to_the_bit,
    simulated,
    wandering_tracks,
    with_mirrored,
)
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.evaluation.improvement.resimulation import needed_rows
from marey_motion.evaluation.improvement.selection import without_rows, without_sources
from marey_motion.evaluation.improvement.unused import Unused, find_unused
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.matching.search import build_index
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import DatabaseOptions

VARIANTS: dict[str, dict[str, Any]] = {
    "as usual": {},
    "by pose distance": {"selection": "pose_distance"},
    "along the path": {"follow": "path"},
    "open loop": {"follow": "open_loop"},
    "with frames nearby barred": {"reselect_window_s": 1.0},
}


def unused_of(database: MatchingDatabase, options: EvaluationOptions = OPTIONS) -> tuple[list[TrialRecord], Unused]:
    records = simulated(database, options)
    return records, find_unused(database, suite_trials(options), records, options)


@pytest.mark.parametrize("variant", VARIANTS)
def test_removing_all_that_is_unused_leaves_every_record_bit_identical(variant: str) -> None:
    options = OPTIONS.replace(controller=OPTIONS.controller.replace(**VARIANTS[variant]))
    database = synthetic_database(wandering_tracks())
    records, unused = unused_of(database, options)
    assert unused.clips
    assert unused.ranges
    less = without_rows(database, unused.rows)
    assert less.row_count < database.row_count
    assert same_to_the_bit(database, records, less, simulated(less, options))


def test_frames_that_a_search_may_not_choose_stay_in_one_clip_with_the_frame_that_bars_them() -> None:
    """The clip repeats itself every 110 frames, and is played alternately around frame 100 and around frame 310.

    While it is played from frame 306 on, searches must not choose its frames from 186 on, which are too near. If the
    unused frames 226 to 266 were removed, the frames before them would be another clip. A search would then choose
    frame 196.
    """
    track = arc_track(1.0, 0.0, 12.0)
    frames = np.arange(len(track.headings))
    pose = np.sin(2 * np.pi * frames[:, None] / 110 + 0.7 * np.arange(15))
    database = synthetic_database([track._replace(pose=pose)])
    farther = np.where(frames < 300, 1e-3 * (2 - frames / 300), np.where(frames < 420, 0.0, 0.3))
    features = database.features.copy()
    features[:, 15:21] += farther[:, None]
    database = replace(database, features=features)
    controller = OPTIONS.controller.replace(reselect_window_s=2.0, continuing_bias=1.0)
    options = OPTIONS.replace(speeds_m_s=(1.0,), turn_rates_deg_s=(0.0,), approach_s=0.4, controller=controller)
    options = options.model_copy(update={"duration_s": 0.1})  # less than may be asked for

    records, unused = unused_of(database, options)

    assert records[0].rows[[0, 7, 13, 19]].tolist() == [300, 87, 313, 99]
    assert unused.rows.any()
    less = without_rows(database, unused.rows)
    assert same_to_the_bit(database, records, less, simulated(less, options))


def test_clips_that_no_trial_displays_are_told_with_their_length() -> None:
    database = synthetic_database(wandering_tracks())
    records, unused = unused_of(database)
    assert {clip.source for clip in unused.clips} >= set(UNWANTED)
    assert all(clip.seconds == 4.0 for clip in unused.clips if clip.source in UNWANTED)
    shown = np.concatenate([record.rows for record in records])
    never = {clip.uid for clip in database.clips if not np.any((shown >= clip.start) & (shown < clip.stop))}
    assert {clip.source for clip in unused.clips} <= never
    less = without_sources(database, [clip.source for clip in unused.clips])
    assert same_to_the_bit(database, records, less, simulated(less))


def test_ranges_keep_their_distance_from_every_frame_that_is_needed() -> None:
    database = synthetic_database(wandering_tracks())
    records, unused = unused_of(database)
    index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)
    needed = np.unique(
        np.concatenate(
            [
                needed_rows(database, index, trial, record, OPTIONS)
                for trial, record in zip(suite_trials(OPTIONS), records, strict=True)
            ]
        )
    )
    starts = {clip.uid: clip for clip in database.clips}
    for part in unused.ranges:
        clip = starts[part.source]
        own = needed[(needed >= clip.start) & (needed < clip.stop)] - clip.start
        assert len(own)
        assert part.seconds >= 0.5
        assert np.all((own - 30 > part.stop - 1) | (own + 60 + 30 < part.start))
    assert int(unused.rows.sum()) == round(
        60 * (sum(clip.seconds for clip in unused.clips) + sum(part.seconds for part in unused.ranges))
    )


def test_the_times_of_a_range_are_those_of_the_recording_and_not_of_its_first_row() -> None:
    database = synthetic_database(wandering_tracks())
    later = replace(database, clips=tuple(replace(clip, first_s=2.5) for clip in database.clips))
    parts, moved = (
        find_unused(one, suite_trials(OPTIONS), simulated(one), OPTIONS).ranges for one in (database, later)
    )
    assert parts
    for part, other in zip(parts, moved, strict=True):
        assert (other.source, other.start, other.stop) == (part.source, part.start, part.stop)
        assert (other.start_s, other.stop_s) == (part.start_s + 2.5, part.stop_s + 2.5)
        assert other.seconds == pytest.approx(part.seconds)


def test_a_clip_of_which_only_the_mirrored_twin_is_used_stays_with_it() -> None:
    database = with_mirrored(wandering_tracks(3))
    records, unused = unused_of(database)
    shown = {uid for record in records for uid, _ in places_of(database, record)}
    gone = {clip.source for clip in unused.clips}
    assert not {uid.removesuffix("~mirrored") for uid in shown} & gone
    less = without_rows(database, unused.rows)
    assert same_to_the_bit(database, records, less, simulated(less))


def places_of(database: MatchingDatabase, record: TrialRecord) -> set[tuple[str, int]]:
    return {(database.clips[index].uid, 0) for index in np.unique(database.clip_of_row[record.rows])}


def test_a_loop_that_wraps_is_never_cut() -> None:
    tracks = [arc_track(1.5, 0.0, 12.0, loop=True), arc_track(1.5, 50.0, 12.0, loop=True), arc_track(2.0, 0.0, 8.0)]
    database = synthetic_database(named(tracks), DatabaseOptions(end_policy="loop"))
    records, unused = unused_of(database)
    assert not {part.source for part in unused.ranges} & {"clip_000", "clip_001"}
    if unused.rows.any():
        less = without_rows(database, unused.rows)
        assert same_to_the_bit(database, records, less, simulated(less))


def test_what_only_the_last_search_chose_is_needed_too() -> None:
    """A trial that ends with a switch does not display the chosen row, but records the cost of this row."""
    database = synthetic_database(wandering_tracks())
    index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)
    trial = suite_trials(OPTIONS)[0]
    (record,) = run_suite(database, OPTIONS, trials=[trial])
    ends = np.flatnonzero(record.status == Status.REPLACED)
    chosen = record.rows[ends + 1] - 1
    # One that was neither displayed nor chosen before.
    new = [
        at
        for at, (end, row) in enumerate(zip(ends, chosen, strict=True))
        if row not in record.rows[: end + 1] and row not in chosen[:at]
    ]
    tick = int(ends[new[-1]])
    short = replace(trial, duration_s=(tick + 1) / 60 - trial.approach_s)
    (cut,) = run_suite(database, OPTIONS, trials=[short])
    assert len(cut.rows) == tick + 1
    assert record.rows[tick + 1] - 1 in needed_rows(database, index, short, cut, OPTIONS)
