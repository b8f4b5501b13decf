"""Selection of ranges of frames, and cutting of clips into pieces."""

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.edited_takes import make_breathing_walk, make_walk
from tests.support.present import present

from marey_motion.editing.registry import apply_edit, edit_clip
from marey_motion.errors import EditError
from marey_schemas.editing.commands import Concatenate, Split, Trim


def test_trimming_keeps_the_bytes_of_the_frames() -> None:
    walk = make_breathing_walk()
    kept = apply_edit(walk, [Trim(start=20, stop=90)])
    assert np.array_equal(kept.poses, walk.poses[20:90])
    assert kept.translations is not None
    assert walk.translations is not None
    assert np.array_equal(kept.translations, walk.translations[20:90])


def test_trimming_without_a_stop_goes_to_the_end() -> None:
    walk = make_walk()
    assert apply_edit(walk, [Trim(start=100)]).frame_count == walk.frame_count - 100


@pytest.mark.parametrize(("start", "stop"), [(0, 10_000), (500, None)])
def test_frames_that_are_not_there_cannot_be_kept(start: int, stop: int | None) -> None:
    with pytest.raises(EditError, match=r"commands\[0\] \(trim\): the range .* must be within") as refused:
        edit_clip(make_walk(), [Trim(start=start, stop=stop)])
    assert refused.value.code == "frames-missing"


@pytest.mark.parametrize(("start", "stop"), [(7, 7), (9, 3), (-3, 10)])
def test_what_is_no_range_cannot_be_kept(start: int, stop: int) -> None:
    with pytest.raises(ValidationError, match=r"the stop|greater than or equal to 0"):
        Trim(start=start, stop=stop)


def test_pieces_put_together_again_are_the_motion() -> None:
    walk = make_breathing_walk()
    pieces = edit_clip(walk, [Split(at=[40, 41, 120])])
    assert [one.pieces for one in pieces] == [(1,), (2,), (3,), (4,)]
    first, *others = pieces
    sources = {str(number): one.clip for number, one in enumerate(others)}
    commands = [Concatenate(source=name, place="keep", blend_s=0.0) for name in sources]
    whole = apply_edit(first.clip, commands, sources=sources)
    assert np.array_equal(whole.poses, walk.poses)
    assert np.array_equal(present(whole.translations), present(walk.translations))


def test_what_follows_a_split_is_done_to_every_piece() -> None:
    pieces = edit_clip(make_walk(), [Split(at=[60]), Trim(stop=30), Split(at=[10])])
    assert [one.pieces for one in pieces] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert [one.clip.frame_count for one in pieces] == [10, 20, 10, 20]


def test_no_piece_may_be_without_frames() -> None:
    with pytest.raises(EditError, match="leave a piece without frames"):
        edit_clip(make_walk(), [Split(at=[10_000])])


@pytest.mark.parametrize("at", [[0], [50, 50], [60, 50]])
def test_cuts_increase_from_the_second_frame(at: list[int]) -> None:
    with pytest.raises(ValidationError, match=r"in increasing order|greater than or equal to 1"):
        Split(at=at)
