"""Motion matching databases of exact roots: known results, and changes that must not affect a result."""

import numpy as np
import pytest
from tests.support.synthetic_databases import (
    EXACT,
    FOLLOWS,
    Track,
    arc_track,
    circle,
    database_clips,
    mirrored_track,
    offsets,
    on_the_circle,
    path_track,
    play,
    random_tracks,
    switches,
    synthetic_database,
)

from marey_motion.evaluation.scenario import Trial
from marey_schemas.options.matching import ControllerOptions, Selection

# Data that is the scenario


@pytest.mark.parametrize("follow", FOLLOWS)
@pytest.mark.parametrize(("speed", "turn_rate_deg"), [(2.0, 50.0), (1.0, -100.0), (3.0, 25.0)])
def test_a_clip_that_is_the_trajectory_is_played_from_its_start_to_its_end(
    speed: float, turn_rate_deg: float, follow: str
) -> None:
    trial = circle(speed, turn_rate_deg)
    record = play(synthetic_database([path_track(trial)]), trial, EXACT.replace(follow=follow))

    speeds, turn_rates = on_the_circle(record)
    # Where other rows are played than those of the tick, the rounding of a turn's steps adds up instead of repeating.
    assert offsets(record, trial).max() < (5e-12 if follow == "open_loop" else 1e-12)
    chord = -speed * (np.radians(turn_rate_deg) / 60) ** 2 / 24
    np.testing.assert_allclose(speeds.mean() - speed, chord, rtol=1e-3)
    assert abs(turn_rates.mean() - turn_rate_deg) < 1e-12 * 60
    assert speeds.std() < 1e-10
    if follow == "open_loop":
        assert 1 <= switches(record) <= 5  # what is wished jumps where the circle begins
    else:
        assert switches(record) == 0
        assert record.rows.tolist() == list(range(1980))


@pytest.mark.parametrize("follow", FOLLOWS)
def test_a_straight_line_and_a_circle_give_the_wished_speeds(follow: str) -> None:
    for speed, turn_rate_deg, bound in ((1.0, 25.0, 0.5), (2.0, 50.0, 1.0), (3.0, 100.0, 1.5)):
        database = synthetic_database([arc_track(speed, 0.0, 40.0), arc_track(speed, turn_rate_deg, 40.0)])
        trial = circle(speed, turn_rate_deg)

        record = play(database, trial, EXACT.replace(follow=follow))

        speeds, turn_rates = on_the_circle(record)
        assert abs(speeds.mean() - speed) <= 2e-4
        assert abs(turn_rates.mean() - turn_rate_deg) <= 0.5
        if follow == "open_loop":
            assert offsets(record, trial).max() < 1e-9
        if follow == "time":
            assert offsets(record, trial).mean() < bound


def test_a_circle_without_approach_is_followed_exactly() -> None:
    for speed, turn_rate_deg in ((1.0, 25.0), (2.0, 50.0), (3.0, 100.0)):
        database = synthetic_database([arc_track(speed, 0.0, 40.0), arc_track(speed, turn_rate_deg, 40.0)])
        trial = circle(speed, turn_rate_deg, approach_s=0.0, duration_s=30.0)

        assert offsets(play(database, trial), trial).max() < 1e-9


@pytest.fixture(scope="module")
def grid() -> dict[tuple[float, float], object]:
    """Tracks of ten seconds for every pair of speed and turn rate."""
    return {(v, w): arc_track(v, w, 10.0) for v in np.arange(1.0, 3.01, 0.25) for w in np.arange(-100.0, 100.1, 25.0)}


def test_what_a_mirror_closed_dataset_does_to_the_left_it_does_to_the_right(
    grid: dict[tuple[float, float], Track],
) -> None:
    # Gaits of both sides in step, so that mirroring changes the roots alone.
    database = synthetic_database(list(grid.values()))
    for speed, turn_rate_deg in ((1.0, 25.0), (1.75, 75.0), (3.0, 100.0)):
        left, right = circle(speed, turn_rate_deg), circle(speed, -turn_rate_deg)
        difference = offsets(play(database, left), left) - offsets(play(database, right), right)
        assert np.abs(difference).max() < 1e-12


def test_without_tight_turns_tight_circles_are_missed_and_wide_ones_are_not(
    grid: dict[tuple[float, float], Track],
) -> None:
    whole = synthetic_database(list(grid.values()))
    holed = synthetic_database([track for (_, w), track in grid.items() if abs(w) <= 70.0])
    for speed in (1.0, 2.0, 3.0):
        for turn_rate_deg in (75.0, -100.0):
            trial = circle(speed, turn_rate_deg)
            assert offsets(play(whole, trial), trial).mean() < 0.3
            assert offsets(play(holed, trial), trial).mean() > 2.4
        for turn_rate_deg in (0.0, 25.0, -50.0):
            trial = circle(speed, turn_rate_deg)
            assert offsets(play(holed, trial), trial).mean() < 1.0


# What must not change the result


def test_the_mirrored_dataset_mirrors_the_result() -> None:
    tracks = random_tracks(25, seed=1)
    database, mirrored = synthetic_database(tracks), synthetic_database([mirrored_track(track) for track in tracks])
    for number, follow in enumerate(FOLLOWS * 4):
        trial, opposite = circle(1.0 + number / 6, 20.0 + 6 * number), circle(1.0 + number / 6, -20.0 - 6 * number)
        options = ControllerOptions(follow=follow)

        record, other = play(database, trial, options), play(mirrored, opposite, options)

        assert np.array_equal(record.rows, other.rows)
        np.testing.assert_allclose(other.positions, record.positions * (-1.0, 1.0), atol=1e-9)
        np.testing.assert_allclose(other.headings, -record.headings, atol=1e-9)


@pytest.mark.parametrize("selection", ["features", "pose_distance"])
def test_removing_rows_that_are_never_shown_changes_no_bit(selection: Selection) -> None:
    tracks = random_tracks(20, seed=2)
    database = synthetic_database(tracks)
    options = ControllerOptions(selection=selection)
    trials = [circle(1.5, 40.0), circle(2.5, -70.0), Trial("switching", 2.0, 0.3, duration_s=12.0)]
    records = [play(database, trial, options) for trial in trials]
    used = np.unique(database_clips(database, np.concatenate([record.rows for record in records])))
    assert 1 <= len(used) < len(tracks)

    smaller = synthetic_database([tracks[clip] for clip in used], normaliser=database.normaliser)

    for trial, record in zip(trials, records, strict=True):
        again = play(smaller, trial, options)
        clips, clips_again = database_clips(database, record.rows), database_clips(smaller, again.rows)
        assert np.array_equal(clips, used[clips_again])
        assert np.array_equal(record.rows - database.starts[clips], again.rows - smaller.starts[clips_again])
        for name in ("positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"):
            assert getattr(again, name).tobytes() == getattr(record, name).tobytes(), name


def test_a_duplicated_clip_changes_no_trajectory_and_the_lower_uid_is_used() -> None:
    tracks = random_tracks(8, seed=3)
    database = synthetic_database(tracks)
    doubled = synthetic_database([track for track in tracks for _ in range(2)], normaliser=database.normaliser)
    for trial in (circle(1.5, 40.0), circle(2.5, -70.0)):
        record, again = play(database, trial), play(doubled, trial)

        assert again.positions.tobytes() == record.positions.tobytes()
        clips = database_clips(doubled, again.rows)
        assert np.array_equal(clips, 2 * database_clips(database, record.rows))


def test_duplicating_the_whole_dataset_leaves_even_a_fitted_normaliser() -> None:
    tracks = random_tracks(8, seed=3)
    database, doubled = synthetic_database(tracks), synthetic_database(tracks + tracks)
    trial = circle(1.5, 40.0)

    np.testing.assert_allclose(doubled.normaliser.scale, database.normaliser.scale, rtol=1e-14)
    np.testing.assert_allclose(play(doubled, trial).positions, play(database, trial).positions, atol=1e-9)


def test_where_a_clip_was_recorded_does_not_matter() -> None:
    tracks = random_tracks(10, seed=4)
    moved = []
    for number, track in enumerate(tracks):
        angle = 0.7 * number
        sine, cosine = np.sin(angle), np.cos(angle)
        x, z = track.positions.T
        turned = np.stack((x * cosine + z * sine, z * cosine - x * sine), axis=1)
        moved.append(track._replace(positions=turned + np.array([3.0 * number, -7.0]), headings=track.headings + angle))
    trial = circle(2.0, -60.0)

    record, again = play(synthetic_database(tracks), trial), play(synthetic_database(moved), trial)

    assert np.array_equal(record.rows, again.rows)
    np.testing.assert_allclose(again.positions, record.positions, atol=1e-9)


def test_a_turn_rate_near_zero_ends_up_next_to_zero() -> None:
    database = synthetic_database([arc_track(2.0, w, 40.0) for w in (-25.0, 0.0, 25.0)])

    straight, nearly = play(database, circle(2.0, 0.0)), play(database, circle(2.0, 1e-5))

    assert np.linalg.norm(straight.positions - nearly.positions, axis=1).max() < 1e-3


def test_the_same_trial_gives_the_same_bytes() -> None:
    database = synthetic_database(random_tracks(6, seed=6))
    records = [play(database, circle(2.0, 60.0), ControllerOptions()) for _ in range(2)]

    for name in ("rows", "positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost"):
        assert getattr(records[0], name).tobytes() == getattr(records[1], name).tobytes()
