from dataclasses import replace

import numpy as np
import pytest
from tests.support.evaluation_cases import clips_of, walked_record

from marey_motion.evaluation.relevance import (
    clips_of_rows,
    count_switches,
    find_jumps,
    measure_usage,
    recorded_rows,
    sum_by_source,
    treading_share,
    unused_clips,
)
from marey_motion.matching.record import Status

CLIPS = clips_of(10, 20, 5)


def test_rows_belong_to_the_clip_they_lie_in() -> None:
    assert clips_of_rows(CLIPS, np.array([0, 9, 10, 29, 30, 34])).tolist() == [0, 0, 1, 1, 2, 2]


def test_popularity_counts_every_tick_that_a_frame_was_displayed() -> None:
    usage = measure_usage(CLIPS, [walked_record([0, 1, 2, 12, 13]), walked_record([1, 2, 3])])

    assert usage[0].popularity.tolist() == [1, 2, 2, 1, 0, 0, 0, 0, 0, 0]
    assert usage[1].popularity[[2, 3]].tolist() == [1, 1]
    assert [own.ticks for own in usage] == [6, 2, 0]
    assert [own.share for own in usage] == [0.75, 0.25, 0.0]
    assert [own.trials for own in usage] == [2, 1, 0]
    assert [own.clip for own in usage] == [0, 1, 2]


def test_a_clip_that_a_trial_only_begins_with_is_one_that_it_displayed() -> None:
    usage = measure_usage(CLIPS, [walked_record([3, 12, 13]), walked_record([12, 13])])

    assert [own.trials for own in usage] == [1, 2, 0]


def test_entries_count_jumps_into_a_clip_not_the_start_of_a_trial() -> None:
    usage = measure_usage(CLIPS, [walked_record([0, 1, 12, 13, 5, 6, 8, 9])])

    assert [own.entries for own in usage] == [2, 1, 0]


def test_a_clip_no_trial_displayed_is_unused() -> None:
    usage = measure_usage(CLIPS, [walked_record([10, 11]), walked_record([12, 13])])

    assert unused_clips(usage) == (0, 2)


def test_a_mirrored_twin_adds_nothing_to_what_was_recorded() -> None:
    clips = clips_of(10, 20, 20)
    twin = replace(clips[2], uid=f"{clips[1].uid}~mirrored", mirrored_from=clips[1].uid)
    assert recorded_rows(clips, measure_usage(clips, [])) == 50
    assert recorded_rows((*clips[:2], twin), measure_usage((*clips[:2], twin), [])) == 30


def test_nothing_is_used_without_trials() -> None:
    usage = measure_usage(CLIPS, [])

    assert [own.share for own in usage] == [0.0, 0.0, 0.0]
    assert unused_clips(usage) == (0, 1, 2)
    assert count_switches(CLIPS, []).shape == (0, 3)


def test_a_loop_that_begins_again_is_no_jump() -> None:
    record = walked_record([8, 9, 0, 1], [Status.KEPT, Status.KEPT, Status.FORCED, Status.KEPT])

    assert find_jumps(clips_of(10, loop=True), record).ticks.tolist() == []
    assert measure_usage(clips_of(10, loop=True), [record])[0].entries == 0


def test_a_jump_at_the_end_of_a_clip_was_not_chosen_freely() -> None:
    record = walked_record(
        [8, 9, 15, 16, 3], [Status.KEPT, Status.KEPT, Status.FORCED, Status.REPLACED, Status.REPLACING]
    )
    jumps = find_jumps(CLIPS, record)

    assert jumps.ticks.tolist() == [2, 4]
    assert jumps.left.tolist() == [9, 16]
    assert jumps.entered.tolist() == [15, 3]
    assert jumps.forced.tolist() == [True, False]


def test_from_the_last_frame_of_a_clip_to_the_first_of_the_next_is_a_jump() -> None:
    record = walked_record([9, 10, 11], [Status.KEPT, Status.FORCED, Status.KEPT])

    assert find_jumps(CLIPS, record).ticks.tolist() == [1]


def test_equal_switches_are_counted_over_all_trials_in_the_order_of_their_rows() -> None:
    switches = count_switches(
        CLIPS, [walked_record([5, 20, 21, 2]), walked_record([5, 20, 3, 4]), walked_record([5, 20])]
    )

    assert switches.tolist() == [[5, 20, 3], [20, 3, 1], [21, 2, 1]]
    assert switches.dtype == np.int64


def test_the_use_of_a_clip_and_of_its_mirror_image_add_up() -> None:
    clips = clips_of(4, 4, 6)
    clips = (clips[0], replace(clips[1], uid="a~mirrored", mirrored_from="a"), clips[2])
    usage = measure_usage(clips, [walked_record([0, 1, 5, 6, 2, 3])])
    first, second = sum_by_source(clips, usage)

    assert (first.uid, first.clips, first.ticks, first.entries) == ("a", (0, 1), 6, 2)
    assert first.popularity.tolist() == [1, 2, 2, 1]
    assert first.share == pytest.approx(1.0)
    assert (second.uid, second.ticks) == ("c", 0)


def test_a_mirror_image_without_its_source_stands_for_the_source() -> None:
    clips = (replace(clips_of(4)[0], uid="a~mirrored", mirrored_from="a"),)
    (only,) = sum_by_source(clips, measure_usage(clips, [walked_record([0, 1])]))

    assert (only.uid, only.clips, only.ticks) == ("a", (0,), 2)


def test_jumps_back_to_nearly_the_same_frame_are_treading_and_those_across_a_seam_of_clips_are_not() -> None:
    clips = clips_of(100, 100)
    back, far, across = [50, 48, 49], [50, 80, 81], [99, 105, 106]

    assert treading_share(clips, [walked_record(back)]) == 1.0
    assert treading_share(clips, [walked_record(back), walked_record(far), walked_record(across)]) == 1 / 3
    assert treading_share(clips, [walked_record([1, 2, 3])]) is None
