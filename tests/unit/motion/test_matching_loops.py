"""Loops: rows look ahead across the seam, and so do filters. Each round continues where the previous one ended."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.gait import generate_gait, studio_skeleton
from marey_motion.looping import LoopSeam, continue_motion, loop_seam, moves_of_rounds, rotated
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import DatabaseOptions

BODY = MatchingBody.from_mapping(studio_skeleton(), map_joints(studio_skeleton()))
LOOPS = DatabaseOptions(end_policy="loop")


def built(clip: Clip, options: DatabaseOptions = LOOPS, *, loop: bool = True) -> MatchingDatabase:
    return build_database([SourceClip("one", "one", clip, loop=loop)], BODY, options)


def stride_frames(clip: Clip) -> int:
    """Return the number of frames after which the walk repeats itself best."""
    database = built(clip, DatabaseOptions(), loop=False)
    points = database.pose_points[60:]
    lengths = np.arange(30, 120)
    return int(lengths[np.argmin([np.abs(points[:60] - points[length : length + 60]).mean() for length in lengths])])


@pytest.fixture(scope="module", params=[0.0, 0.6], ids=["straight", "turning"])
def long_walk(request: pytest.FixtureRequest) -> Clip:
    return generate_gait(1.35, request.param, 8.0)


def test_a_round_of_a_walk_is_like_that_part_of_the_walk(long_walk: Clip) -> None:
    """A stride that is cut out of a walk and marked as a loop has the same rows as in the walk."""
    length = stride_frames(long_walk)
    loop, walk = built(long_walk.sliced(120, 120 + length)), built(long_walk, loop=False)
    part = slice(120, 120 + length)
    np.testing.assert_allclose(loop.features[:, :6], walk.features[part, :6], atol=0.03)
    np.testing.assert_allclose(loop.features[:, 15:], walk.features[part, 15:], atol=0.04)
    np.testing.assert_allclose(loop.features[:, 12:15], walk.features[part, 12:15], atol=0.3)
    assert loop.selectable.all()
    assert not loop.notes or {note.code for note in loop.notes} == {"scale-floored"}


def test_rows_look_ahead_to_where_playing_on_leads(long_walk: Clip) -> None:
    """The trajectory of each row is the sum of the root's steps in a loop that continues across its seam."""
    database = built(long_walk.sliced(120, 120 + stride_frames(long_walk)))
    motion = database.root_motion
    for first in range(0, database.row_count, 7):
        place, heading, row = np.zeros(2), 0.0, first
        for tick in range(1, 61):
            place = place + rotated(motion.steps[row, :2], heading)
            heading += motion.steps[row, 2]
            row = int(motion.successors[row])
            if tick in (20, 40, 60):
                at = 15 + 2 * (tick // 20 - 1)
                np.testing.assert_allclose(database.features[first, at : at + 2], place, atol=1e-9)
                direction = [np.sin(heading), np.cos(heading)]
                np.testing.assert_allclose(database.features[first, at + 6 : at + 8], direction, atol=1e-9)


def test_a_loop_that_begins_elsewhere_has_the_same_rows(long_walk: Clip) -> None:
    """If the loop is cut at another frame, its rows are the same in another order."""
    length = stride_frames(long_walk)
    motion = Motion.of(long_walk.sliced(120, 120 + length))
    positions = motion.positions(long_walk.skeleton)
    seam = loop_seam(positions[:, BODY.torso][:, [0, 2]], _facing(positions))
    going_on = continue_motion(motion, seam, 0, length)
    shift = length // 3
    other = built(going_on.at_frames(np.arange(shift, shift + length)).as_clip(long_walk.skeleton, 60.0))
    here = built(long_walk.sliced(120, 120 + length))
    np.testing.assert_allclose(np.roll(other.features, shift, axis=0), here.features, atol=0.05)
    np.testing.assert_allclose(np.roll(other.features, shift, axis=0)[:, 15:], here.features[:, 15:], atol=0.01)


def _facing(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    pairs = zip(BODY.lefts, BODY.rights, strict=True)
    across = np.sum([positions[:, left] - positions[:, right] for left, right in pairs], axis=0)
    return np.unwrap(np.arctan2(-across[:, 2], across[:, 0]))


def test_without_the_policy_a_loop_is_a_clip_that_ends(long_walk: Clip) -> None:
    clip = long_walk.sliced(120, 180)
    as_loop, plain = built(clip, DatabaseOptions()), built(clip, DatabaseOptions(), loop=False)
    assert as_loop.features.tobytes() == plain.features.tobytes()
    assert as_loop.clips[0].loop
    assert as_loop.root_motion.successors[-1] == -1
    assert built(clip, loop=False).selectable.sum() == 40


def test_a_mirrored_loop_turns_the_other_way(long_walk: Clip) -> None:
    clip = long_walk.sliced(120, 120 + stride_frames(long_walk))
    plain, mirrored = built(clip), built(clip, LOOPS.replace(mirroring="only"))
    signs = np.tile([-1.0, 1.0], 6)
    np.testing.assert_allclose(mirrored.features[:, 15:], plain.features[:, 15:] * signs, atol=1e-9)
    assert mirrored.selectable.all()


def test_a_last_frame_that_repeats_the_first_is_left_out() -> None:
    walk = generate_gait(1.35, 0.0, 8.0)
    length = stride_frames(walk)
    poses = walk.sliced(120, 121 + length).poses.copy()
    poses[-1, 3:] = poses[0, 3:]
    database = built(replace(walk, poses=poses))
    assert database.row_count == length
    assert database.features.tobytes() == built(walk.sliced(120, 120 + length)).features.tobytes()
    assert "loop-end-repeated" in [note.code for note in database.notes]


def test_a_loop_that_does_not_close_is_told_of() -> None:
    walk = generate_gait(1.35, 0.0, 8.0)
    half = stride_frames(walk) // 2
    assert "loop-does-not-close" in [note.code for note in built(walk.sliced(120, 120 + half)).notes]


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_loops_of_few_frames_go_round_many_times(frames: int) -> None:
    database = built(generate_gait(1.0, 0.3, 1.0).sliced(20, 20 + frames))
    assert np.all(np.isfinite(database.features))
    assert database.selectable.all()


def test_a_loop_at_another_rate_keeps_its_round() -> None:
    walk = generate_gait(1.35, 0.0, 8.0, 30.0)
    length = stride_frames(generate_gait(1.35, 0.0, 8.0)) // 2
    database = built(walk.sliced(60, 60 + length))
    assert database.row_count == 2 * length
    speeds = np.linalg.norm(database.root_motion.steps[:, :2], axis=1) * 60
    assert speeds.mean() == pytest.approx(1.35, abs=0.03)
    assert np.ptp(speeds) < 0.3


class TestSeams:
    def test_the_closing_step_is_the_mean_of_its_neighbours(self) -> None:
        angles = 0.3 + 0.05 * np.arange(12.0)
        places = np.stack((2 - 2 * np.cos(angles), 2 * np.sin(angles)), axis=1)
        seam = loop_seam(places, angles)
        assert seam.turn_rad == pytest.approx(12 * 0.05)
        np.testing.assert_allclose(
            rotated(places[0], seam.turn_rad) + seam.shift_m, [2 - 2 * np.cos(0.9), 2 * np.sin(0.9)]
        )

    def test_rounds_repeat_the_same_move_in_both_directions(self) -> None:
        seam = LoopSeam(0.7, np.array([0.4, 1.5]))
        turns, shifts = moves_of_rounds(seam, np.array([-2, -1, 0, 1, 2]))
        np.testing.assert_allclose(turns, 0.7 * np.arange(-2, 3))
        point = np.array([0.3, -0.2])
        places = rotated(point, turns) + shifts
        np.testing.assert_allclose(rotated(places[:-1], 0.7) + seam.shift_m, places[1:], atol=1e-12)
        np.testing.assert_allclose(places[2], point)
