"""Motion matching databases of real takes. Some takes have 120 Hz; in some, the hips move relative to a static root."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tests.support.real_takes import body_of, read_takes

from marey_motion.kinematics import global_positions
from marey_motion.looping import rotated
from marey_motion.matching.building import build_database
from marey_motion.matching.database import DatabaseClip, MatchingDatabase, SourceClip
from marey_schemas.options.matching import DatabaseOptions

SUBJECTS = ("02", "05", "07", "09", "16")
SWAY_DEG = 50.0  # by which a trunk turns to and fro in a dash: takes begin and end within a stride
SETS = ("bandai-namco-1", "bandai-namco-2")


@pytest.fixture(
    scope="module", params=[*(f"cmu-amc/{subject}/*" for subject in SUBJECTS), *(f"{one}/*.bvh" for one in SETS)]
)
def takes(mocap: Path, request: pytest.FixtureRequest) -> list[SourceClip]:
    return read_takes(mocap, request.param)


@pytest.fixture(scope="module")
def database(takes: list[SourceClip]) -> MatchingDatabase:
    return build_database(takes, body_of(takes[0].clip))


def courses(database: MatchingDatabase, clip: DatabaseClip) -> tuple[np.ndarray, np.ndarray]:
    """Return the root's velocities (F - 1, 2) to the left and forward in m/s, and the root's turn rates in rad/s."""
    steps = database.root_motion.steps[clip.start : clip.stop - 1] * database.options.rate_hz
    return steps[:, :2], steps[:, 2]


def test_every_take_is_in_the_database_with_sound_rows(takes: list[SourceClip], database: MatchingDatabase) -> None:
    assert len(database.clips) == len(takes)
    assert database.selectable.any()
    assert not database.normaliser.floored
    for take, clip in zip(takes, database.clips, strict=True):
        lasting = (take.clip.frame_count - 1) / take.clip.frame_rate_hz
        assert abs((clip.frame_count - 1) / 60.0 - lasting) < 1 / 60.0 or "rest-pose" in str(database.notes)
    for array in (database.features, database.poses, database.pose_points, database.root_headings):
        assert np.all(np.isfinite(array))


def test_roots_are_where_the_bodies_are_and_never_jump(takes: list[SourceClip], database: MatchingDatabase) -> None:
    for take, clip in zip(takes, database.clips, strict=True):
        velocities, turn_rates = courses(database, clip)
        hips = global_positions(take.clip)[:, database.body.hips][:, [0, 2]]
        at_60_hz = hips[np.round(np.arange(clip.frame_count) * take.clip.frame_rate_hz / 60.0).astype(int)]
        roots = database.root_positions[clip.start : clip.stop]
        assert np.linalg.norm(roots - at_60_hz, axis=1).max() < 0.5, clip.name
        speeds = np.linalg.norm(velocities, axis=1)
        assert speeds.max() < 6.0, clip.name
        assert np.abs(np.diff(velocities, axis=0)).max(initial=0.0) * 60 < 30.0, clip.name
        assert np.degrees(np.abs(turn_rates)).max() < 900.0, clip.name


def test_feet_stand_about_as_long_as_feet_do(database: MatchingDatabase) -> None:
    """In a walk, a foot is on the ground for about half of the time; in a run, for much less."""
    for clip in database.clips:
        share = database.contacts[clip.start : clip.stop].mean()
        speed = np.linalg.norm(courses(database, clip)[0], axis=1).mean()
        if speed > 3.0:
            assert share < 0.25, clip.name
        if 0.7 < speed < 1.3 and "walk" in clip.name:
            assert 0.2 < share < 0.7, clip.name


def test_mirrored_takes_are_the_takes_in_a_mirror(takes: list[SourceClip]) -> None:
    """Real bodies are not exactly symmetric, so the roots of a take and of its mirrored copy may differ by 1 cm."""
    body = body_of(takes[0].clip)
    plain = build_database(takes[:6], body)
    mirrored = build_database(takes[:6], body, DatabaseOptions(mirroring="only"))
    np.testing.assert_allclose(mirrored.root_positions, plain.root_positions * [-1.0, 1.0], atol=0.01)
    np.testing.assert_allclose(mirrored.features[:, 0], -plain.features[:, 3], atol=0.02)


NAMED = {
    "walk-back": lambda left, forward: forward < -0.4,
    "walk-left": lambda left, forward: left > 0.1,
    "walk-right": lambda left, forward: left < -0.1,
    "run": lambda left, forward: forward > 1.0,
    "dash": lambda left, forward: forward > 1.5,
    "bow": lambda left, forward: abs(forward) < 0.1,
}


@pytest.mark.parametrize("collection", SETS)
def test_takes_go_where_their_names_and_turn_as_far_as_the_manifest_say(mocap: Path, collection: str) -> None:
    """The manifest states the net turn of each take in degrees, positive to the right.

    Some names confuse left and right.
    """
    with (mocap / "MANIFEST.csv").open(newline="") as table:
        net_turns = {
            row["path"]: -float(row["note"].split("net turn ")[1].split(";")[0])
            for row in csv.DictReader(table)
            if "net turn" in row["note"]
        }
    takes = read_takes(mocap, f"{collection}/*.bvh")
    database = build_database(takes, body_of(takes[0].clip))
    for clip in database.clips:
        velocities, turn_rates = courses(database, clip)
        turned = np.degrees(turn_rates.sum() / 60.0)
        if clip.uid in net_turns:
            assert turned == pytest.approx(net_turns[clip.uid], abs=SWAY_DEG), clip.name
        kind = clip.name.split("_")[1]
        if kind in NAMED:
            assert NAMED[kind](*velocities.mean(axis=0)), f"{clip.name}: {velocities.mean(axis=0)} m/s"
    assert len(net_turns.keys() & {clip.uid for clip in database.clips}) > 30


def test_poses_hung_from_their_roots_are_the_takes(takes: list[SourceClip]) -> None:
    """The stored pose points are relative to the root.

    Placed at the root, they equal the joint positions of the clip.
    """
    body = body_of(takes[0].clip)
    for take in takes[:4]:
        database = build_database([take], body)
        step = take.clip.frame_rate_hz / 60.0
        frames = np.arange(0, database.row_count, 2 if step < 1 else 1)
        at = np.round(frames * step).astype(int)
        expected = global_positions(take.clip)[at][:, list(body.pose_joints)]
        points = database.pose_points[frames].astype(np.float64)
        points[..., [0, 2]] = rotated(points[..., [0, 2]], database.root_headings[frames, None])
        points[..., [0, 2]] += database.root_positions[frames, None]
        np.testing.assert_allclose(points, expected, atol=1e-4)
