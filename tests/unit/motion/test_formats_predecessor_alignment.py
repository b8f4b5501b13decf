"""Documents of Marey's predecessor for aligned clips."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.alignment import (
    PredecessorAlignment,
    as_increasing,
    read_predecessor_alignment,
    write_predecessor_alignment,
)

FRAMES = [0, 0, 1, 3, 3, 3, 4, 7, 8, 9]


def read(document: dict[str, Any]) -> PredecessorAlignment:
    return read_predecessor_alignment(json.dumps(document).encode(), "a.json")


@pytest.mark.parametrize("wrap", [lambda one: one, json.dumps, lambda one: json.dumps(json.dumps(one))])
def test_a_time_function_is_read_as_a_list_or_as_text_of_one(wrap: Callable[..., Any]) -> None:
    found = read({"time_function": wrap(FRAMES), "sections": [{"start_idx": 0, "end_idx": 4}]})
    np.testing.assert_array_equal(found.frames, FRAMES)
    assert found.sections == ((0, 4),)


def test_what_is_written_is_read_again_and_written_the_same() -> None:
    written = write_predecessor_alignment(np.array(FRAMES, dtype=float), [(0, 4), (4, 10)])
    found = read_predecessor_alignment(written, "a.json")
    assert write_predecessor_alignment(found.frames.astype(float), found.sections) == written


@given(st.lists(st.integers(0, 5), min_size=1, max_size=60), st.integers(0, 10))
def test_a_stair_of_frames_becomes_a_function_that_rises_strictly_and_stays_near(steps: list[int], rest: int) -> None:
    frames = np.concatenate(([0], np.cumsum(steps)))
    source_frames = int(frames[-1]) + 1 + rest
    assume(len(frames) > 1 and source_frames - 1 > 0.01 * len(frames))
    times = as_increasing(frames, source_frames)
    assert times[0] == 0.0
    assert times[-1] == source_frames - 1
    assert (np.diff(times) > 0).all()


def test_where_the_stair_stands_time_goes_on_evenly() -> None:
    times = as_increasing(np.array([0, 1, 1, 1, 2, 3]), 4)
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0, 1.5, 2.0, 3.0])


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ({}, "'time_function' must be a list"),
        ({"time_function": "["}, "'time_function' cannot be read"),
        ({"time_function": [0, 0.5]}, "list of at least two frames"),
        ({"time_function": [0, 1e308]}, "contains frame 1e.308; the limit is"),
        ({"time_function": [0, 5, 4]}, "decreases at canonical frame 2"),
        (
            {"time_function": [0, 1], "sections": [{"start_idx": 0, "end_idx": 3}]},
            "section 0:3 is not a range of the 2",
        ),
    ],
)
def test_damaged_alignments_are_refused_by_the_field(document: dict[str, Any], told: str) -> None:
    with pytest.raises(FormatError, match=told):
        read(document)


def test_a_time_function_beyond_its_source_is_refused() -> None:
    with pytest.raises(FormatError, match="contains frame 9, but the source has 9 frames"):
        as_increasing(np.array(FRAMES), 9)
