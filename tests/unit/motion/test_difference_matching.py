"""Matching of the frames of two clips, compared with an exhaustive search over all sequences of runs."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marey_motion.difference.matching import AT_AN_END, NEW_RUN, UNMATCHED, _cheapest, match_frames
from marey_motion.difference.poses import Poses, frame_costs

ANGLES_RAD = np.radians([0.0, 3.0, 10.0, 40.0])


def poses_of(kinds: list[int]) -> Poses:
    """Return frames with a root that does not move and one joint, whose rotation is one of four, chosen by `kinds`."""
    halves = ANGLES_RAD[kinds] / 2.0
    zeros = np.zeros_like(halves)
    rotations = np.stack((np.cos(halves), np.sin(halves), zeros, zeros), axis=-1)[:, None]
    return Poses(np.zeros((len(kinds), 3), np.float32), rotations.astype(np.float32))


def least_cost(before: Poses, after: Poses) -> float:
    """Return the least cost over all sequences of runs."""
    n, m = before.frame_count, after.frame_count
    places = np.stack(np.meshgrid(np.arange(n), np.arange(m), indexing="ij"), axis=-1).reshape(-1, 2)
    costs = np.minimum(frame_costs(before, after, places), 2.0 * UNMATCHED).reshape(n, m)

    @cache
    def rest(i: int, j: int) -> float:
        left = n - i + m - j
        if i == n or j == m:
            return left * UNMATCHED + (AT_AN_END if left else 0.0)
        return min(costs[i, j] + rest(i + 1, j + 1), shifted(i, j))

    @cache
    def shifted(i: int, j: int) -> float:
        removed = (k * UNMATCHED + NEW_RUN + rest(i + k, j) for k in range(1, n - i + 1))
        inserted = (k * UNMATCHED + NEW_RUN + rest(i, j + k) for k in range(1, m - j + 1))
        return min(*removed, *inserted)

    starts = [(k, 0) for k in range(1, n)] + [(0, k) for k in range(1, m)]
    return min(rest(0, 0), *(sum(start) * UNMATCHED + AT_AN_END + rest(*start) for start in starts), np.inf)


KINDS = st.lists(st.integers(0, 3), min_size=1, max_size=7)


@given(before=KINDS, after=KINDS)
@settings(max_examples=50, deadline=None)
def test_the_cheapest_matching_over_all_lags_is_that_of_an_exhaustive_search(
    before: list[int], after: list[int]
) -> None:
    old, new = poses_of(before), poses_of(after)
    found = _cheapest(old, new, range(-len(before) + 1, len(after)))
    assert found.total == pytest.approx(least_cost(old, new), abs=1e-6)


@given(before=KINDS, after=KINDS)
@settings(max_examples=50, deadline=None)
def test_pairs_increase_and_their_costs_are_those_of_the_matching(before: list[int], after: list[int]) -> None:
    old, new = poses_of(before), poses_of(after)
    found = match_frames(old, new)
    assert (np.diff(found.pairs, axis=0) > 0).all()
    if len(found.pairs):
        expected = np.minimum(frame_costs(old, new, found.pairs), 2.0 * UNMATCHED)
        np.testing.assert_allclose(found.costs, expected, atol=1e-9)
        assert (found.pairs >= 0).all()
        assert (found.pairs.max(axis=0) < (len(before), len(after))).all()
    assert found.total >= least_cost(old, new) - 1e-6


@given(before=KINDS, after=KINDS)
@settings(max_examples=20, deadline=None)
def test_exchanging_the_clips_costs_the_same(before: list[int], after: list[int]) -> None:
    lags = range(-len(before) + 1, len(after))
    there = _cheapest(poses_of(before), poses_of(after), lags)
    back = _cheapest(poses_of(after), poses_of(before), [-lag for lag in lags])
    assert there.total == pytest.approx(back.total, abs=1e-6)


def test_frames_that_differ_entirely_for_long_are_replaced() -> None:
    kinds = [0] * 20
    found = match_frames(poses_of([*kinds, *[0] * 12, *kinds]), far_away(20, 32, 52))
    assert [pair[0] for pair in found.pairs.tolist()] == [*range(20), *range(32, 52)]


def far_away(start: int, stop: int, count: int) -> Poses:
    """Return equal frames, apart from one range in which joint and root have other values."""
    poses = poses_of([0] * count)
    poses.roots[start:stop] = 5.0
    poses.rotations[start:stop] = poses_of([3]).rotations[0]
    return poses
