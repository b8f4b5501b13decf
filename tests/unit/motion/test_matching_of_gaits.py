"""Motion matching on whole bodies: generated gaits are converted to a database and then played.

The torso sways with the steps and leans into a curve. So the root is centimetres away from the path for which the gait
was generated. It moves on slightly smaller circles, at a slightly lower speed. Tolerances take this into account.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from marey_motion.clip import Clip
from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.gait import PathSegment, RootPath, generate_along, generate_dataset
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.controller import run_trial
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.matching.search import SearchIndex, build_index
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions, Follow

FOLLOWS = ("time", "path", "open_loop")
EXACT = ControllerOptions(root_inertialisation=False, reselect_window_s=0.0)
UNBARRED = ControllerOptions(reselect_window_s=0.0)
"""Options under which a search may choose any frame, so that copies of a clip make no difference."""
LEAN_M = 0.04
"""Greatest distance in metres between the torso and the curve of the feet, towards the inside."""


def circle(speed: float, turn_rate_deg: float, **options: Any) -> Trial:
    return Trial("circle", speed, float(np.radians(turn_rate_deg)), **options)


def take(uid: str, *segments: tuple[float, float, float]) -> SourceClip:
    """Return a walk or run along segments of (seconds, speed in m/s, turn rate in deg/s)."""
    path = RootPath(tuple(PathSegment(seconds, speed, float(np.radians(turn))) for seconds, speed, turn in segments))
    return SourceClip(uid, uid, generate_along(path))


def database_of(
    clips: Sequence[SourceClip], options: DatabaseOptions | None = None, normaliser: Normaliser | None = None
) -> MatchingDatabase:
    skeleton = clips[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(clips, body, options or DatabaseOptions(), normaliser=normaliser)


def index_of(database: MatchingDatabase) -> SearchIndex:
    return build_index(database.normaliser.apply(database.features), database.starts, database.selectable)


def play(database: MatchingDatabase, path: Trial | Reference, options: ControllerOptions = EXACT) -> TrialRecord:
    path = reference(path) if isinstance(path, Trial) else path
    return run_trial(database, index_of(database), path, options)


def offsets(record: TrialRecord, trial: Trial) -> np.ndarray:
    return np.linalg.norm(record.positions - reference(trial).positions[: len(record.rows)], axis=1)


def static_errors(record: TrialRecord, trial: Trial) -> tuple[float, float]:
    """Return the mean error of the speed in m/s and of the turn rate in deg/s, after the approach."""
    first = round(trial.approach_s * 60)
    speed = np.linalg.norm(np.diff(record.positions, axis=0), axis=1)[first:].mean() * 60
    turn_rate = np.degrees(np.diff(record.headings))[first:].mean() * 60
    return speed - trial.speed_m_s, turn_rate - np.degrees(trial.turn_rate_rad_s)


@pytest.fixture(scope="module")
def takes() -> list[SourceClip]:
    """Twenty-four takes, each of another walker, that turn left and right with different gaits."""
    return [SourceClip(f"clip_{number:02d}", made.name, made.clip) for number, made in enumerate(generate_dataset())]


@pytest.fixture(scope="module")
def dataset(takes: list[SourceClip]) -> MatchingDatabase:
    return database_of(takes)


TRIALS = (circle(1.5, 40.0), circle(3.0, -30.0), Trial("switching", 1.0, 0.5, duration_s=15.0))


# Data that is the scenario


@pytest.mark.parametrize("follow", ["time", "path"])
@pytest.mark.parametrize(("speed", "turn_rate_deg"), [(2.0, 50.0), (1.0, -100.0), (3.0, 25.0)])
def test_a_clip_asked_to_do_what_it_does_is_played_through(speed: float, turn_rate_deg: float, follow: str) -> None:
    database = database_of([take("clip", (3.0, speed, 0.0), (31.0, speed, turn_rate_deg))])
    steps = np.linalg.norm(np.diff(database.root_positions, axis=0, append=database.root_positions[-1:]), axis=1)
    own = Reference(
        rate_hz=60.0,
        tick_count=1980,
        positions=database.root_positions,
        headings=database.root_headings,
        speeds_m_s=60 * steps,
        turn_rates_rad_s=60 * np.diff(database.root_headings, append=database.root_headings[-1]),
        directions=database.root_headings,
    )

    record = play(database, own, EXACT.replace(follow=follow))

    assert record.rows.tolist() == list(range(1980))
    assert np.abs(record.positions - database.root_positions[:1980]).max() < 1e-12
    assert not np.any(record.status == Status.REPLACING)


@pytest.mark.parametrize(("speed", "turn_rate_deg"), [(2.0, 50.0), (1.0, -100.0), (3.0, 25.0)])
def test_a_clip_made_for_the_trajectory_stays_within_centimetres_of_it(speed: float, turn_rate_deg: float) -> None:
    trial = circle(speed, turn_rate_deg)
    database = database_of([take("clip", (3.0, speed, 0.0), (31.0, speed, turn_rate_deg))])

    record = play(database, trial)

    bias, turn_bias = static_errors(record, trial)
    assert offsets(record, trial).max() < 0.1
    assert -LEAN_M * abs(trial.turn_rate_rad_s) < bias < 2e-3
    assert abs(turn_bias) < 0.5


@pytest.mark.parametrize("follow", FOLLOWS)
@pytest.mark.parametrize(("speed", "turn_rate_deg"), [(1.0, 25.0), (2.0, 50.0), (3.0, 100.0)])
def test_a_straight_walk_and_a_circle_give_the_wished_speeds(speed: float, turn_rate_deg: float, follow: str) -> None:
    trial = circle(speed, turn_rate_deg)
    database = database_of([take("a", (40.0, speed, 0.0)), take("b", (40.0, speed, turn_rate_deg))])

    record = play(database, trial, EXACT.replace(follow=follow))

    bias, turn_bias = static_errors(record, trial)
    assert -LEAN_M * trial.turn_rate_rad_s < bias < 2e-3
    assert abs(turn_bias) <= 0.5
    if follow == "time":
        assert offsets(record, trial).mean() < speed / 2
    if follow == "open_loop":
        assert offsets(record, trial).mean() < 0.1


def test_a_circle_without_approach_is_followed_within_centimetres() -> None:
    trial = circle(2.0, 50.0, approach_s=0.0)
    database = database_of([take("a", (40.0, 2.0, 0.0)), take("b", (40.0, 2.0, 50.0))])

    assert offsets(play(database, trial), trial).max() < 0.1


def test_a_turn_rate_near_zero_ends_up_next_to_zero() -> None:
    database = database_of([take(f"clip {turn}", (40.0, 2.0, turn)) for turn in (-25.0, 0.0, 25.0)])

    straight, nearly = play(database, circle(2.0, 0.0)), play(database, circle(2.0, 1e-5))

    assert np.linalg.norm(straight.positions - nearly.positions, axis=1).max() < 1e-3


def test_without_tight_turns_tight_circles_are_missed_and_wide_ones_are_not() -> None:
    grid = {
        turn: [take(f"v={speed} w={turn}", (10.0, speed, turn)) for speed in (1.0, 2.0, 3.0)]
        for turn in np.arange(-100.0, 100.1, 25.0)
    }
    whole = database_of([clip for clips in grid.values() for clip in clips])
    holed = database_of([clip for turn, clips in grid.items() if abs(turn) <= 70.0 for clip in clips])
    for speed in (1.0, 2.0, 3.0):
        for turn_rate_deg in (75.0, -100.0):
            trial = circle(speed, turn_rate_deg)
            assert offsets(play(whole, trial), trial).mean() < 0.5
            assert offsets(play(holed, trial), trial).mean() > 1.2
        for turn_rate_deg in (0.0, 25.0, -50.0):
            trial = circle(speed, turn_rate_deg)
            assert offsets(play(holed, trial), trial).mean() < 1.0


# Mirror images


@pytest.mark.parametrize("follow", FOLLOWS)
def test_the_mirrored_dataset_mirrors_the_result(
    takes: list[SourceClip], dataset: MatchingDatabase, follow: Follow
) -> None:
    mirrored = database_of(takes, DatabaseOptions(mirroring="only"))
    options = ControllerOptions(follow=follow)
    for speed, turn_rate_deg in ((1.3, 40.0), (2.0, -60.0), (1.0, -100.0)):
        record = play(dataset, circle(speed, turn_rate_deg), options)
        other = play(mirrored, circle(speed, -turn_rate_deg), options)

        assert places(dataset, record) == places(mirrored, other)
        np.testing.assert_allclose(other.positions, record.positions * (-1.0, 1.0), atol=1e-9)
        np.testing.assert_allclose(other.headings, -record.headings, atol=1e-9)


def places(database: MatchingDatabase, record: TrialRecord) -> list[tuple[str, int]]:
    """Return the source clip and the frame of each displayed row."""
    found = []
    for row in record.rows.tolist():
        clip = database.clips[database.clip_of_row[row]]
        found.append((clip.mirrored_from or clip.uid, row - clip.start))
    return found


@pytest.mark.parametrize("follow", FOLLOWS)
def test_what_a_mirror_closed_dataset_does_to_the_left_it_does_to_the_right(
    takes: list[SourceClip], follow: Follow
) -> None:
    """The trials have no straight approach, because the left and the right trial would begin it in the same row."""
    closed = database_of(takes, DatabaseOptions(mirroring="add"))
    options = ControllerOptions(follow=follow)
    for speed, turn_rate_deg in ((1.3, 40.0), (2.0, 60.0), (1.0, 100.0)):
        left, right = (circle(speed, sign * turn_rate_deg, approach_s=0.0) for sign in (1, -1))

        difference = offsets(play(closed, left, options), left) - offsets(play(closed, right, options), right)

        assert np.abs(difference).max() < 1e-9


# What must not change the result


def test_removing_clips_that_are_never_shown_changes_no_bit(takes: list[SourceClip], dataset: MatchingDatabase) -> None:
    records = [play(dataset, trial, ControllerOptions()) for trial in TRIALS]
    used = np.unique(np.concatenate([dataset.clip_of_row[record.rows] for record in records]))
    assert 1 <= len(used) < len(takes)

    smaller = database_of([takes[clip] for clip in used], normaliser=dataset.normaliser)

    for trial, record in zip(TRIALS, records, strict=True):
        again = play(smaller, trial, ControllerOptions())
        assert places(smaller, again) == places(dataset, record)
        for name in ("positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"):
            assert getattr(again, name).tobytes() == getattr(record, name).tobytes(), name


def test_duplicated_clips_change_no_trajectory_and_the_lower_uid_is_used(
    takes: list[SourceClip], dataset: MatchingDatabase
) -> None:
    twice = [*takes, *(replace(clip, uid=f"{clip.uid} again") for clip in takes)]
    doubled = database_of(twice, normaliser=dataset.normaliser)
    for trial in TRIALS:
        record, again = (play(database, trial, UNBARRED) for database in (dataset, doubled))

        assert again.positions.tobytes() == record.positions.tobytes()
        assert places(doubled, again) == places(dataset, record)


def test_boxes_and_scan_give_the_same_bytes(dataset: MatchingDatabase) -> None:
    normalised = dataset.normaliser.apply(dataset.features)
    indices = [
        build_index(normalised, dataset.starts, dataset.selectable, method=method) for method in ("boxes", "scan")
    ]
    for trial in TRIALS:
        records = [run_trial(dataset, index, reference(trial), ControllerOptions()) for index in indices]
        for name in ("rows", "positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"):
            assert getattr(records[0], name).tobytes() == getattr(records[1], name).tobytes(), name


# Loops


def test_a_loop_of_two_strides_walks_on_for_half_a_minute() -> None:
    walk = take("walk", (20.0, 1.4, 0.0)).clip
    stride = best_stride(walk)
    looping = database_of(
        [SourceClip("walk", "walk", walk.sliced(300, 300 + stride), loop=True)], DatabaseOptions(end_policy="loop")
    )
    trial = circle(1.4, 0.0)

    record = play(looping, trial, EXACT.replace(follow="open_loop", continuing_bias=-1000.0))

    assert np.count_nonzero(record.status == Status.FORCED) == -(-1980 // stride)
    assert not np.any(record.status == Status.REPLACING)
    bias, _ = static_errors(record, trial)
    assert abs(bias) < 0.02
    assert record.pose_cost.max() < 3 * np.median(record.pose_cost)


def best_stride(walk: Clip) -> int:
    """Return the number of frames after which the pose repeats best."""
    rotations = walk.rotations[300:].astype(np.float64)
    distances = [np.linalg.norm(rotations[lag] - rotations[0]) for lag in range(40, 100)]
    return 40 + int(np.argmin(distances))
