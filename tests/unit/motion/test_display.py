"""The motion that the character shows in a trial of motion matching."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.present import present

from marey_motion import quaternions
from marey_motion.evaluation.scenario import Trial, reference
from marey_motion.gait import PathSegment, RootPath, generate_along
from marey_motion.kinematics import global_positions
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.controller import run_trial
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.display import displayed_clip, pose_costs, switched_rows
from marey_motion.matching.inertialisation import decay_matrix
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.matching.search import build_index
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions

OPTIONS = ControllerOptions()


def arc(speed: float, turn_rate_deg: float, seconds: float, travel_deg: float = 0.0) -> RootPath:
    segment = PathSegment(seconds, speed, np.radians(turn_rate_deg), travel_angle_rad=np.radians(travel_deg))
    return RootPath((segment,))


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    """Walks and runs of different walkers, straight ahead, and to the left and right."""
    paths = [arc(speed, turn, 6.0) for speed in (1.0, 2.0, 3.5) for turn in (-60.0, 0.0, 60.0)]
    clips = [
        SourceClip(f"clip_{number:02d}", f"arc {number}", generate_along(path)) for number, path in enumerate(paths)
    ]
    skeleton = clips[0].clip.skeleton
    return build_database(clips, MatchingBody.from_mapping(skeleton, map_joints(skeleton)))


def walk_and_run(rate_hz: float) -> MatchingDatabase:
    clips = [
        SourceClip(name, name, generate_along(arc(speed, 0.0, 3.0), rate_hz))
        for name, speed in (("a", 1.0), ("b", 3.5))
    ]
    body = MatchingBody.from_mapping(clips[0].clip.skeleton, map_joints(clips[0].clip.skeleton))
    return build_database(clips, body, DatabaseOptions(rate_hz=rate_hz))


@pytest.fixture(scope="module")
def record(database: MatchingDatabase) -> TrialRecord:
    trial = Trial("switching", 1.5, np.radians(40), duration_s=12.0, switch_speed_m_s=3.0, switch_every_s=2.0)
    index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)
    made = run_trial(database, index, reference(trial), OPTIONS)
    assert np.count_nonzero(made.status == Status.REPLACING) > 5
    return made


def undisturbed(database: MatchingDatabase, first: int, ticks: int) -> TrialRecord:
    """Return the record of a trial that plays consecutive rows of the database, with the root path of these rows."""
    rows = np.arange(first, first + ticks, dtype=np.int32)
    nothing = np.full(ticks, np.nan)
    return TrialRecord(
        rate_hz=database.options.rate_hz,
        rows=rows,
        positions=database.root_positions[rows],
        headings=database.root_headings[rows],
        status=np.zeros(ticks, np.int8),
        match_cost=nothing,
        continuing_cost=nothing,
        pose_cost=np.zeros(ticks),
    )


def jump(database: MatchingDatabase, before: int, after: int, ticks: int = 60) -> TrialRecord:
    """Return the record of a trial that plays rows from `before` on, and in its second half rows from `after` on.

    The root does not move.
    """
    rows = np.concatenate((before + np.arange(ticks // 2), after + np.arange(ticks - ticks // 2))).astype(np.int32)
    return replace(undisturbed(database, 0, ticks), rows=rows, positions=np.zeros((ticks, 2)), headings=np.zeros(ticks))


def test_rows_played_as_they_were_recorded_are_the_clip_itself(database: MatchingDatabase) -> None:
    original = generate_along(arc(1.0, -60.0, 6.0))

    shown = displayed_clip(database, undisturbed(database, 0, 360), OPTIONS)

    assert shown.skeleton is database.body.skeleton
    assert shown.frame_rate_hz == 60.0
    np.testing.assert_allclose(global_positions(shown), global_positions(original), atol=2e-5)


def test_the_root_is_where_the_record_has_it(database: MatchingDatabase) -> None:
    turned = replace(
        undisturbed(database, 0, 100), positions=np.tile((3.0, -2.0), (100, 1)), headings=np.full(100, np.pi / 2)
    )

    shown = global_positions(displayed_clip(database, turned, OPTIONS))

    joints = list(database.body.pose_joints)
    points = database.pose_points[:100].astype(np.float64)
    # Facing +x, forward is +x and left is -z.
    expected = np.stack((3.0 + points[..., 2], points[..., 1], -2.0 - points[..., 0]), axis=-1)
    np.testing.assert_allclose(shown[:, joints], expected, atol=2e-5)


def test_poses_do_not_jump_where_rows_do(database: MatchingDatabase, record: TrialRecord) -> None:
    """At a switch, joint angles change from tick to tick hardly more than within a clip."""
    shown = displayed_clip(database, record, OPTIONS)

    step = quaternions.angle_between(shown.rotations[1:, 1:], shown.rotations[:-1, 1:]).max(axis=1)
    raw = database.poses[record.rows, 7:].reshape(len(record.rows), -1, 4)
    raw_step = quaternions.angle_between(raw[1:], raw[:-1]).max(axis=1)
    switched = record.status[1:] == Status.REPLACING
    in_clips = float(np.quantile(raw_step[~switched], 0.99))
    assert raw_step[switched].max() > 3 * in_clips
    assert step.max() < 2 * in_clips


@pytest.mark.parametrize("rate_hz", [60.0, 240.0])
def test_position_and_velocity_are_continuous_at_a_switch(rate_hz: float) -> None:
    """The change of velocity at a switch shrinks with the length of a tick, so it is an acceleration, not a jump."""
    fine = walk_and_run(rate_hz)
    before, after = round(0.9 * rate_hz), int(fine.starts[1]) + round(1.2 * rate_hz)
    half = round(0.5 * rate_hz)

    def shown(record: TrialRecord) -> np.ndarray:
        return global_positions(displayed_clip(fine, record, OPTIONS)).astype(np.float64)

    blended = shown(jump(fine, before, after, 2 * half))
    old, new = shown(jump(fine, before, before + half, 2 * half)), shown(jump(fine, after - half, after, 2 * half))

    last, tick_s = half - 1, 1.0 / rate_hz
    assert largest(new[last] - old[last]) > 0.4
    velocity, old_velocity, new_velocity = (np.diff(motion, axis=0)[last] / tick_s for motion in (blended, old, new))
    assert largest(new_velocity - old_velocity) > 3.0
    np.testing.assert_allclose(blended[:half], old[:half], atol=1e-6)
    # Springs of this half-life accelerate by y^2 per metre and 2 y per m/s that they have to bridge.
    y = 2 * np.log(2) / OPTIONS.half_life_s
    bridged = y**2 * largest(new[last] - old[last]) + 2 * y * largest(new_velocity - old_velocity)
    assert largest(velocity - old_velocity) < bridged * tick_s


def largest(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def test_what_is_left_of_a_switch_follows_the_closed_form(database: MatchingDatabase) -> None:
    """The height of the hips is a plain number, so its offset can be computed by hand."""
    before, after = 30, int(database.starts[4]) + 47
    record = jump(database, before, after)
    shown = displayed_clip(database, record, OPTIONS)

    height = database.poses[:, 1].astype(np.float64)
    at, cut = before + 29, after - 1
    offset = height[at] - height[cut]
    velocity = 60 * ((height[at + 1] - height[at]) - (height[cut + 1] - height[cut]))
    for ticks in (1, 6, 20):
        left = (decay_matrix(0.1, ticks / 60) @ (offset, velocity))[0]
        np.testing.assert_allclose(shown.root_translations[29 + ticks, 1], height[cut + ticks] + left, atol=1e-6)


def test_rotations_are_blended_the_short_way_whatever_the_signs_of_their_quaternions() -> None:
    clip = generate_along(arc(1.5, 0.0, 3.0))
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    negated = clip.poses * np.where(np.arange(clip.poses.shape[1]) < 3, 1, -1).astype(np.float32)
    takes = [SourceClip("a", "a", clip), SourceClip("b", "b", replace(clip, poses=negated))]
    database = build_database(takes, body)

    within = displayed_clip(database, jump(database, 30, 95), OPTIONS)
    across = displayed_clip(database, jump(database, 30, int(database.starts[1]) + 95), OPTIONS)

    np.testing.assert_allclose(global_positions(across), global_positions(within), atol=1e-6)


def test_a_joint_that_moves_against_its_parent_is_blended_in_place_and_velocity() -> None:
    clip = generate_along(arc(1.5, 0.0, 3.0))
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    joint = body.standard_joints["left_wrist"]
    swing = 0.05 * np.sin(5.0 * np.arange(clip.frame_count) / 60 + np.array([[0.0], [0.7], [1.4]])).T
    places = (clip.skeleton.offsets[joint] + swing)[:, None].astype(np.float32)
    moving = replace(clip, translations=places, translated_joints=(joint,))
    database = build_database([SourceClip("clip", "clip", moving)], body)
    before, after = 30, 110

    shown = present(displayed_clip(database, jump(database, before, after), OPTIONS).translations)[:, 0]

    held, cut = before + 29, after - 1
    place = places[:, 0].astype(np.float64)
    velocity = 60 * ((place[held + 1] - place[held]) - (place[cut + 1] - place[cut]))
    for ticks in (1, 6, 20):
        left = (decay_matrix(0.1, ticks / 60) @ np.stack((place[held] - place[cut], velocity)))[0]
        np.testing.assert_allclose(shown[29 + ticks], place[cut + ticks] + left, atol=1e-6)


def test_a_clip_that_ends_is_left_with_the_velocity_that_it_ended_with(database: MatchingDatabase) -> None:
    last, after = int(database.starts[1]) - 1, int(database.starts[4]) + 47
    shown = displayed_clip(database, jump(database, last - 29, after), OPTIONS)

    height = database.poses[:, 1].astype(np.float64)
    cut = after - 1
    offset = height[last] - height[cut]
    velocity = 60 * ((height[last] - height[last - 1]) - (height[cut + 1] - height[cut]))
    for ticks in (1, 6, 20):
        left = (decay_matrix(0.1, ticks / 60) @ (offset, velocity))[0]
        np.testing.assert_allclose(shown.root_translations[29 + ticks, 1], height[cut + ticks] + left, atol=1e-6)


def test_a_second_switch_takes_along_what_is_left_of_the_first(database: MatchingDatabase) -> None:
    rows = np.concatenate((30 + np.arange(10), 780 + np.arange(4), 2000 + np.arange(20))).astype(np.int32)
    record = replace(undisturbed(database, 0, 34), rows=rows, positions=np.zeros((34, 2)), headings=np.zeros(34))

    shown = global_positions(displayed_clip(database, record, OPTIONS)).astype(np.float64)

    speeds = np.linalg.norm(np.diff(shown, axis=0), axis=-1).max(axis=1) * 60
    assert speeds[13] < 2 * speeds[:9].max()


def test_a_switch_is_where_another_row_than_the_next_follows(database: MatchingDatabase, record: TrialRecord) -> None:
    cuts = switched_rows(database, record.rows)

    jumps = record.status[1:] == Status.REPLACING
    forced = np.flatnonzero(record.status == Status.FORCED)
    assert np.all(cuts[:-1][jumps] == record.rows[1:][jumps] - 1)
    others = np.setdiff1d(np.flatnonzero(~jumps), forced - 1)
    assert np.all(cuts[others] == -1)
    assert cuts[-1] == -1


# The cost of poses


def test_pose_cost_is_the_distance_from_the_displayed_pose_to_the_next_row(
    database: MatchingDatabase, record: TrialRecord
) -> None:
    standing = replace(record, positions=np.zeros_like(record.positions), headings=np.zeros_like(record.headings))
    shown = global_positions(displayed_clip(database, standing, OPTIONS))[:, list(database.body.pose_joints)]

    expected = np.linalg.norm(shown[:-1] - database.pose_points[record.rows[1:]], axis=-1).sum(axis=-1)

    np.testing.assert_allclose(record.pose_cost[:-1], expected, atol=1e-4)
    assert np.array_equal(pose_costs(database, record.rows, OPTIONS), record.pose_cost)


def test_pose_cost_is_highest_at_a_switch_and_dies_away_with_the_blend(database: MatchingDatabase) -> None:
    rows = jump(database, 30, int(database.starts[7]) + 47, 120).rows

    costs = pose_costs(database, rows, OPTIONS)

    steps = pose_costs(database, rows[60:], OPTIONS)
    assert np.argmax(costs) == 59
    assert costs[59] > 5 * costs[:59].max()
    assert np.all(np.diff(costs[59:70]) < 0)
    np.testing.assert_allclose(costs[110:], steps[50:], atol=1e-3)


def test_without_a_switch_pose_cost_is_one_step_of_the_clip(database: MatchingDatabase) -> None:
    rows = np.arange(100, 200, dtype=np.int32)

    costs = pose_costs(database, rows, OPTIONS)

    steps = np.linalg.norm(np.diff(database.pose_points[100:201].astype(np.float64), axis=0), axis=-1).sum(axis=-1)
    np.testing.assert_allclose(costs, steps, atol=2e-6)


def test_a_loops_seam_is_no_switch() -> None:
    seconds = 2.0
    clip = generate_along(arc(1.5, 0.0, seconds))
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    looping = build_database([SourceClip("clip", "loop", clip, loop=True)], body, DatabaseOptions(end_policy="loop"))
    rows = np.concatenate((np.arange(60, 120), np.arange(60))).astype(np.int32)

    assert np.all(switched_rows(looping, rows) == -1)


def test_a_switch_to_the_last_row_of_a_loop_shows_in_its_first_row() -> None:
    clip = generate_along(arc(1.5, 0.0, 2.0))
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    loops = [SourceClip(uid, uid, clip, loop=True) for uid in ("a", "b")]
    looping = build_database(loops, body, DatabaseOptions(end_policy="loop"))
    rows = np.array([10, 11, 120, 121, 30, 0, 1], np.int32)

    assert switched_rows(looping, rows).tolist() == [-1, 239, -1, 29, 119, -1, -1]
