"""Division of clips into sections by labels, and alignments that match the n-th sections of two clips."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_motion.alignment.dtw import align
from marey_motion.alignment.segments import (
    Cut,
    align_sections,
    common_labels,
    cuts_of,
    require_labels,
    sections_of,
)
from marey_motion.arrays import Floats
from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import AnnotationError


def test_segments_cut_where_they_begin_and_where_a_gap_follows_them() -> None:
    layer = Layer(
        50,
        (Segment("reach", 5, 20), Segment("hold", 20, 30), Segment("retract", 35, 50)),
        (Keyframe("contact", 18),),
    )
    assert cuts_of(layer) == (
        Cut(("reach",), 5),
        Cut(("contact",), 18),
        Cut(("hold",), 20),
        Cut(("end of hold",), 30),
        Cut(("retract",), 35),
    )


def test_labels_on_one_frame_are_one_cut() -> None:
    layer = Layer(50, (Segment("reach", 0, 20), Segment("hold", 20, 50)), (Keyframe("contact", 20),))
    assert cuts_of(layer) == (Cut(("reach",), 0), Cut(("contact", "hold"), 20))


def test_labels_that_repeat_are_numbered_in_the_order_of_time() -> None:
    layer = Layer(60, (Segment("left", 0, 20), Segment("right", 20, 40), Segment("left", 40, 60)))
    assert [cut.labels for cut in cuts_of(layer)] == [("left",), ("right",), ("left 2",)]
    clash = Layer(60, (Segment("left", 0, 20), Segment("left", 20, 40), Segment("left 2", 40, 60)))
    with pytest.raises(
        AnnotationError, match="left 2: one cut has this label, and another label that repeats gets the same name"
    ):
        cuts_of(clash)


def test_sections_lie_between_the_ends_and_the_cuts_at_the_rate_of_the_set() -> None:
    found = sections_of((Cut(("contact",), 20),), 51, rate_ratio=0.5)
    assert found.bounds == (0, 10, 50)
    assert found.labels == ((), ("contact",), ())
    assert found.keyframes == {"contact": 10}


def test_a_cut_on_the_first_or_last_frame_labels_that_end() -> None:
    found = sections_of((Cut(("reach",), 0), Cut(("grasp",), 29)), 30)
    assert found.bounds == (0, 29)
    assert found.keyframes == {"reach": 0, "grasp": 29}


def test_cuts_that_fall_on_one_frame_leave_no_section_and_are_refused() -> None:
    with pytest.raises(AnnotationError, match=r"hold: the cut is on the same frame as contact"):
        sections_of((Cut(("contact",), 20), Cut(("hold",), 21)), 30, rate_ratio=0.4)


def test_the_labels_that_most_examples_have_are_the_common_ones() -> None:
    odd, usual, other = ((), ("a",), ()), ((), ("a",), ("b",), ()), ((), ("b",), ("a",), ())
    assert common_labels({"2": usual, "1": odd, "3": usual}) == usual
    assert common_labels({"2": usual, "1": other}) == usual
    require_labels(usual, usual)
    with pytest.raises(AnnotationError, match="the annotation cuts the clip at b, a, but the other clips at a, b"):
        require_labels(other, usual)
    with pytest.raises(AnnotationError, match="the annotation cuts the clip at none, but the other clips at a"):
        require_labels(((), ()), odd)
    with pytest.raises(
        AnnotationError, match=r"the annotation cuts the clip at a \(first frame\), but the other clips at a;"
    ):
        require_labels((("a",), ()), odd)


@st.composite
def sectioned(draw: Callable[..., Any]) -> tuple[Floats, list[int], list[int]]:
    """Draw costs of two motions with the same number of sections, and the bounds of the sections."""
    count = draw(st.integers(1, 4))
    lengths = st.integers(1, 12)
    bounds = [np.concatenate(([0], np.cumsum(draw(st.lists(lengths, min_size=count, max_size=count))))) for _ in "ab"]
    seed = draw(st.integers(0, 2**32 - 1))
    costs = np.random.default_rng(seed).random((bounds[0][-1] + 1, bounds[1][-1] + 1))
    return costs, bounds[0].tolist(), bounds[1].tolist()


@given(sectioned())
def test_the_ends_of_every_section_are_matched_exactly_and_time_never_runs_back(
    example: tuple[Floats, list[int], list[int]],
) -> None:
    costs, reference, source = example
    found = align_sections(costs, reference, source, align)
    assert found.times[reference].tolist() == [float(bound) for bound in source]
    assert len(found.times) == len(costs)
    assert np.diff(found.times).min() > 0.0
    cells = {tuple(cell) for cell in found.path.tolist()}
    assert cells >= set(zip(reference, source, strict=True))
    assert len(cells) == len(found.path)


@given(sectioned())
def test_the_path_of_all_sections_is_one_way_that_costs_the_total(example: tuple[Floats, list[int], list[int]]) -> None:
    costs, reference, source = example
    found = align_sections(costs, reference, source, align)
    steps = {tuple(step) for step in np.diff(found.path, axis=0).tolist()}
    assert steps <= {(1, 1), (1, 0), (0, 1)}
    assert found.total == pytest.approx(costs[found.path[:, 0], found.path[:, 1]].sum(), abs=1e-9)
    assert found.mean_cost == pytest.approx(found.total / len(found.path))


def test_sections_are_put_behind_each_other_instead_of_each_beginning_at_frame_0() -> None:
    """An earlier program began each section at frame 0: it counted the frames 0, 1, ..., 22, 23, 0, 0, 1, ... here."""
    costs = np.abs(np.arange(48)[:, None] - np.arange(48)[None]).astype(float)
    found = align_sections(costs, (0, 23, 47), (0, 23, 47), partial(align, max_run=3))
    assert found.times.tolist() == list(range(48))
    one, other = next(pair for pair in pairwise(found.times.tolist()) if pair[0] == 23.0)
    assert other == one + 1


def test_one_section_is_the_plain_alignment() -> None:
    costs = np.random.default_rng(4).random((20, 23))
    found = align_sections(costs, (0, 19), (0, 22), partial(align, max_run=3))
    plain = align(costs, max_run=3)
    assert found.path.tolist() == plain.path.tolist()
    assert found.total == plain.total
