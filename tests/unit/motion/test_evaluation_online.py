"""Coverage during a recording, and targets to perform next. Pieces of any length give the windows of a whole clip."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.present import present

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import Windows, cell_counts, cell_edges, sliding_windows
from marey_motion.evaluation.live_windows import LiveWindows, smoother
from marey_motion.evaluation.online import FARTHEST_M, OnlineCoverage
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.simulation_root import simulation_root
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.options.evaluation import Grid

RATE_HZ = 60.0
TOLERANCE = 1e-10


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def afterwards(clip: Clip, body: MatchingBody) -> Windows:
    """Return the windows of a whole clip at its own rate, as evaluations compute them."""
    root = simulation_root(Motion.of(clip).positions(clip.skeleton), body, clip.frame_rate_hz)
    return sliding_windows(root.positions, root.headings, clip.frame_rate_hz)


def cut(count: int, lengths: tuple[Any, ...]) -> Iterator[slice]:
    """Yield consecutive slices of `count` frames, whose lengths are taken from `lengths` in turn."""
    start, turn = 0, 0
    while start < count:
        yield slice(start, start + lengths[turn % len(lengths)])
        start, turn = start + lengths[turn % len(lengths)], turn + 1


def streamed(online: OnlineCoverage, clip: Clip, lengths: tuple[Any, ...] = (10,), *, end: bool = True) -> Windows:
    body = body_of(clip)
    parts = [
        online.add_frames(body, clip.sliced(piece.start, min(piece.stop, clip.frame_count)))
        for piece in cut(clip.frame_count, lengths)
    ]
    if end:
        parts.append(online.end_take())
    return Windows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def differences(found: Windows, wanted: Windows) -> float:
    assert [len(column) for column in found] == [len(column) for column in wanted]
    return max(float(np.max(np.abs(a - b), initial=0.0)) for a, b in zip(found, wanted, strict=True))


def circling(
    speed_m_s: float, turn_rate_deg_s: float, duration_s: float, rate_hz: float = RATE_HZ
) -> tuple[Floats, Floats]:
    """Return positions and headings of a root that moves at constant speed in the direction that it faces."""
    turn_rate = math.radians(turn_rate_deg_s)
    headings = turn_rate * np.arange(round(duration_s * rate_hz) + 1, dtype=np.float64) / rate_hz
    steps = speed_m_s / rate_hz * np.stack((np.sin(headings), np.cos(headings)), axis=-1)
    return np.vstack((np.zeros(2), np.cumsum(steps, axis=0)[:-1])), headings


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.4, math.radians(60.0), 7.0, frame_rate_hz=RATE_HZ)


@pytest.mark.parametrize("rate_hz", [10.0, 24.0, 27.0, 30.0, 60.0, 100.0, 120.0, 240.0])
def test_a_whole_clip_has_the_windows_that_are_found_afterwards_its_ends_included(rate_hz: float) -> None:
    clip = generate_gait(1.4, math.radians(-60.0), 5.0, frame_rate_hz=rate_hz)
    body = body_of(clip)
    online = OnlineCoverage(rate_hz)
    wanted = afterwards(clip, body)
    assert differences(streamed(online, clip), wanted) < TOLERANCE
    edges = online.speed_edges_m_s, online.turn_rate_edges_deg_s
    counts = cell_counts(wanted.speed_m_s, edges[0], np.degrees(wanted.turn_rate_rad_s), edges[1])
    assert online.counts.tolist() == counts.tolist()
    assert online.seconds.sum() == pytest.approx(counts.sum() / rate_hz)


def test_until_the_take_ends_the_last_half_second_is_all_that_lacks(walk: Clip) -> None:
    body, online = body_of(walk), OnlineCoverage(RATE_HZ)
    wanted = afterwards(walk, body)
    found = streamed(online, walk, end=False)
    assert online.delay_s == 0.5
    assert len(found.speed_m_s) == len(wanted.speed_m_s) - 30
    assert differences(found, Windows(*(column[:-30] for column in wanted))) < TOLERANCE


@pytest.mark.parametrize("lengths", [(1,), (7,), (60,), (59, 61, 2), (1000,)])
def test_how_frames_are_cut_does_not_change_a_bit(walk: Clip, lengths: tuple[Any, ...]) -> None:
    one, other = OnlineCoverage(RATE_HZ), OnlineCoverage(RATE_HZ)
    wanted = streamed(one, walk, (13,), end=False)
    found = streamed(other, walk, lengths, end=False)
    assert all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True))
    assert encode_tree(one.as_tree(), MSGPACK) == encode_tree(other.as_tree(), MSGPACK)


@pytest.mark.parametrize("frames", range(1, 70))
def test_a_short_take_counts_as_a_short_clip_does(walk: Clip, frames: int) -> None:
    body, online = body_of(walk), OnlineCoverage(RATE_HZ)
    clip = walk.sliced(0, frames)
    assert differences(streamed(online, clip), afterwards(clip, body)) < TOLERANCE


@pytest.mark.parametrize("frames", [28, 29, 30])
def test_a_take_shorter_than_the_filter_with_a_window_in_it_counts_too(frames: int) -> None:
    clip = generate_gait(1.4, 0.3, 3.0, frame_rate_hz=27.0).sliced(0, frames)
    body, online = body_of(clip), OnlineCoverage(27.0)
    assert differences(streamed(online, clip), afterwards(clip, body)) < TOLERANCE
    assert online.frame_count == frames


def test_no_window_lies_across_a_pause(walk: Clip) -> None:
    body, online = body_of(walk), OnlineCoverage(RATE_HZ)
    halves = walk.sliced(0, 200), walk.sliced(200, walk.frame_count)
    found = [streamed(online, half) for half in halves]
    assert [differences(a, afterwards(half, body)) < TOLERANCE for a, half in zip(found, halves, strict=True)] == [
        True,
        True,
    ]
    without_pause = OnlineCoverage(RATE_HZ)
    streamed(without_pause, walk)
    assert without_pause.frame_count == online.frame_count
    assert sum(len(part.speed_m_s) for part in found) == walk.frame_count - 120


def test_ending_a_take_twice_or_before_it_began_changes_nothing(walk: Clip) -> None:
    online = OnlineCoverage(RATE_HZ)
    assert len(online.end_take().speed_m_s) == 0
    streamed(online, walk)
    before = encode_tree(online.as_tree(), MSGPACK)
    assert len(online.end_take().speed_m_s) == 0
    assert encode_tree(online.as_tree(), MSGPACK) == before


def test_what_was_kept_goes_on_to_the_same_bits(walk: Clip) -> None:
    body = body_of(walk)
    straight, stopped = OnlineCoverage(RATE_HZ), OnlineCoverage(RATE_HZ)
    for piece in cut(walk.frame_count, (33,)):
        frames = walk.sliced(piece.start, min(piece.stop, walk.frame_count))
        expected = straight.add_frames(body, frames)
        kept = encode_tree(stopped.as_tree(), MSGPACK)
        stopped = OnlineCoverage.from_tree(decode_tree(kept, MSGPACK))
        found = stopped.add_frames(body, frames)
        assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    assert encode_tree(stopped.as_tree(), MSGPACK) == encode_tree(straight.as_tree(), MSGPACK)


def test_what_is_kept_of_the_largest_grid_at_the_highest_rate_is_small() -> None:
    grid = Grid(speeds_m_s=tuple(0.1 * step for step in range(1, 41)), turn_rates_deg_s=tuple(range(-75, 75, 3)))
    online = OnlineCoverage(240.0, grid, seconds=np.full((40, 50), 0.123))
    online.add_roots(*circling(1.0, 10.0, 5.0, 240.0))
    assert len(encode_tree(online.as_tree(), MSGPACK)) < 64 * 1024


def test_hours_of_a_performance_leave_no_rounding_behind() -> None:
    positions, headings = circling(1.25, 24.0, 60.0)
    online = OnlineCoverage(RATE_HZ)
    first = online.add_roots(positions, headings)
    for minute in range(1, 120):
        windows = online.add_roots(positions, headings + minute * headings[-1])  # four rounds
        last = Windows(*(column[-3000:] for column in windows))
        assert differences(last, Windows(*(column[-3000:] for column in first))) < 1e-11


def test_roots_count_as_the_poses_they_were_taken_from(walk: Clip) -> None:
    from marey_motion.matching.simulation_root import raw_root

    body = body_of(walk)
    by_poses, by_roots = OnlineCoverage(RATE_HZ), OnlineCoverage(RATE_HZ)
    raw = raw_root(Motion.of(walk).positions(walk.skeleton), body)
    expected = by_poses.add_frames(body, walk)
    assert differences(by_roots.add_roots(raw.positions, raw.headings), expected) < TOLERANCE
    assert by_roots.counts.tolist() == by_poses.counts.tolist()


def test_a_circle_fills_its_cell_second_by_second() -> None:
    online = OnlineCoverage(RATE_HZ)
    positions, headings = circling(2.0, 50.0, 10.0)
    online.add_roots(positions[:151], headings[:151])  # a second for the first window, half a one of delay
    cell = 4, 6
    assert online.seconds[cell] == pytest.approx(61 / 60)
    assert np.count_nonzero(online.counts) == 1
    assert online.deficit_s[cell] == 0.0
    assert online.index == 1 / 81
    online.add_roots(positions[151:], headings[151:])
    online.end_take()
    assert online.counts[cell] == 601 - 60


def test_it_begins_with_what_is_there_already() -> None:
    seconds = np.full((9, 9), 0.75)
    online = OnlineCoverage(RATE_HZ, seconds=seconds)
    assert online.deficit_s == pytest.approx(0.25)
    online.add_roots(*circling(1.0, 0.0, 2.0))
    online.end_take()
    assert online.deficit_s[0, 4] == 0.0
    assert online.seconds[0, 4] == pytest.approx(0.75 + 61 / 60)
    assert seconds.tolist() == np.full((9, 9), 0.75).tolist()


def test_targets_are_the_lacking_cells_nearest_to_how_the_performer_moves() -> None:
    online = OnlineCoverage(RATE_HZ)
    assert [target.hole.speed_m_s for target in online.targets(3)] == [1.0, 1.0, 1.0]  # nearest to standing still
    assert online.targets(1)[0].hole.turn_rate_deg_s == 0.0
    online.add_roots(*circling(2.0, 50.0, 5.0))
    first, second, *_ = online.targets(81)
    assert {(one.hole.speed_m_s, one.hole.turn_rate_deg_s) for one in online.targets(4)} == {
        (1.75, 50.0), (2.25, 50.0), (2.0, 25.0), (2.0, 75.0)
    }  # fmt: skip
    assert len(online.targets(100)) == 80
    assert (first.hole.deficit_s, second.hole.deficit_s) == (1.0, 1.0)
    assert online.targets(0) == ()


def test_of_two_targets_as_near_the_one_that_lacks_more_comes_first() -> None:
    seconds = np.zeros((9, 9))
    seconds[4, 5], seconds[4, 7] = 0.5, 0.25
    online = OnlineCoverage(RATE_HZ, seconds=seconds)
    online.add_roots(*circling(2.0, 50.0, 5.0))
    assert [target.hole.deficit_s for target in online.targets(4)] == [1.0, 1.0, 0.75, 0.5]


def test_the_cell_that_the_performer_is_filling_comes_first_until_it_is_full() -> None:
    online = OnlineCoverage(RATE_HZ)
    positions, headings = circling(2.0, 50.0, 5.0)
    online.add_roots(positions[:110], headings[:110])
    hole = online.targets(1)[0].hole
    assert (hole.speed_m_s, hole.turn_rate_deg_s) == (2.0, 50.0)
    assert 0.0 < hole.deficit_s < 1.0
    online.add_roots(positions[110:], headings[110:])
    assert (2.0, 50.0) not in {(one.hole.speed_m_s, one.hole.turn_rate_deg_s) for one in online.targets(81)}


def test_nothing_is_asked_for_once_every_cell_has_enough() -> None:
    online = OnlineCoverage(
        RATE_HZ, Grid(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(0.0,)), seconds=np.array([[5.0], [1.0]])
    )
    assert online.targets(3) == ()
    assert online.index == 1.0


def test_who_walks_a_targets_path_fills_its_cell() -> None:
    online = OnlineCoverage(RATE_HZ, Grid(speeds_m_s=(1.5,), turn_rates_deg_s=(-40.0,)))
    (target,) = online.targets(1, path_s=4.0)
    path = target.path
    assert path.positions[0].tolist() == [0.0, 0.0]
    assert path.headings[0] == 0.0
    assert path.headings[-1] == pytest.approx(math.radians(-40.0 * 4.0))
    assert path.positions[1, 1] > 0.0  # ahead
    assert path.positions[2, 0] < 0.0  # and to the right
    times = np.arange(len(path.headings)) / path.rate_hz
    fine = np.arange(round(4.0 * RATE_HZ)) / RATE_HZ
    walked = np.stack([np.interp(fine, times, path.positions[:, axis]) for axis in (0, 1)], axis=-1)
    online.add_roots(walked, np.interp(fine, times, path.headings))
    online.end_take()
    assert online.index == 1.0


def test_the_performer_is_where_the_newest_frame_has_him_and_moves_as_the_newest_window(walk: Clip) -> None:
    online = OnlineCoverage(RATE_HZ)
    at_first = online.performer
    assert at_first is None
    positions, headings = circling(2.0, 50.0, 3.0)
    online.add_roots(positions[:50], headings[:50])
    assert present(online.performer).window is None
    windows = online.add_roots(positions[50:], headings[50:])
    now = online.performer
    assert (present(now).x_m, present(now).z_m) == tuple(positions[-1])
    assert present(now).heading_rad == pytest.approx(headings[-1])
    assert tuple(present(present(now).window)) == tuple(column[-1] for column in windows)
    online.end_take()
    assert online.performer is None


def test_a_body_that_lies_on_its_side_keeps_its_last_direction(walk: Clip) -> None:
    poses = walk.poses.copy()
    lying = poses[:40].copy()
    lying[:, 3:7] = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # sideways axis upright
    taken = replace(walk, poses=np.concatenate((poses[:100], lying, poses[140:])))
    one, other = OnlineCoverage(RATE_HZ), OnlineCoverage(RATE_HZ)
    wanted = streamed(one, taken, (400,))
    found = streamed(other, taken, (1,))
    assert all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_frames_that_are_nowhere_are_refused_and_change_nothing(walk: Clip) -> None:
    body, online = body_of(walk), OnlineCoverage(RATE_HZ)
    online.add_frames(body, walk.sliced(0, 100))
    before = encode_tree(online.as_tree(), MSGPACK)
    poses = walk.poses.copy()
    poses[:, 0] = 3e38
    with pytest.raises(MotionError, match="from the origin"):
        online.add_frames(body, replace(walk, poses=poses))
    far = np.array([[2.0 * FARTHEST_M, 0.0]])
    with pytest.raises(MotionError, match="from the origin"):
        online.add_roots(far, np.zeros(1))
    for bad in (np.array([[np.nan, 0.0]]), np.array([[np.inf, 0.0]])):
        with pytest.raises(MotionError):
            online.add_roots(bad, np.zeros(1))
    for heading in (np.nan, np.inf):
        with pytest.raises(MotionError, match="roots: a heading is infinite or not a number"):
            online.add_roots(np.zeros((1, 2)), np.array([heading]))
    with pytest.raises(MotionError, match=r"1 headings need positions of the shape \(1, 2\), not \(2, 2\)"):
        online.add_roots(np.zeros((2, 2)), np.zeros(1))
    assert encode_tree(online.as_tree(), MSGPACK) == before


@pytest.mark.parametrize("rate_hz", [0.0, 9.9, 240.1, float("nan"), float("inf")])
def test_rates_beyond_those_of_recordings_are_refused(rate_hz: float) -> None:
    with pytest.raises(MotionError, match="the frame rate must be"):
        LiveWindows(rate_hz)


def test_grids_that_do_not_fit_are_refused() -> None:
    with pytest.raises(MotionError, match="at most 2000"):
        OnlineCoverage(
            RATE_HZ, Grid(speeds_m_s=tuple(0.1 * n for n in range(1, 102)), turn_rates_deg_s=tuple(range(20)))
        )
    with pytest.raises(MotionError, match="of the grid"):
        OnlineCoverage(RATE_HZ, seconds=np.zeros((9, 8)))


@pytest.mark.parametrize("window", [5, 31, 61, 241])
def test_the_smoother_is_the_filter_of_the_simulation_root(window: int) -> None:
    from scipy.signal import savgol_filter

    values = np.random.default_rng(1).normal(size=window)
    assert smoother(window) @ values == pytest.approx(savgol_filter(values, window, 3), abs=1e-12)


def test_cells_are_those_of_evaluations() -> None:
    grid = Grid(speeds_m_s=(2.0, 1.0), turn_rates_deg_s=(10.0, -30.0, 0.0))
    online = OnlineCoverage(RATE_HZ, grid)
    assert online.speed_edges_m_s.tolist() == cell_edges(grid.speeds_m_s, 0.25).tolist()
    assert online.counts.shape == (2, 3)


@pytest.mark.parametrize("folder", ["bandai-namco-2", "cmu-bvh"])  # the first moves joints below the root, too
def test_real_performances_have_the_windows_that_are_found_afterwards(mocap: Path, folder: str) -> None:
    from marey_motion import read_motion

    file = next(iter(sorted((mocap / folder).rglob("*.bvh"))))
    clip = read_motion(file.read_bytes(), file.name).clip
    body, online = body_of(present(clip)), OnlineCoverage(present(clip).frame_rate_hz)
    assert differences(streamed(online, present(clip), (17,)), afterwards(present(clip), body)) < TOLERANCE
