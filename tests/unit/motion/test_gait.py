"""Generated gaits: exact roots, feet that do not slide, and constant bone lengths."""

from math import pi, radians
from typing import Any

import numpy as np
import pytest

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import (
    GaitStyle,
    PathSegment,
    RootPath,
    foot_motions,
    game_skeleton,
    generate_along,
    generate_dataset,
    generate_gait,
    start_and_stop,
    straight_or_arc,
    studio_skeleton,
)

RATE_HZ = 60.0
FLOAT32_M = 2e-6  # rounding of float32 at some ten metres

# name: (speed m/s, turn deg/s, direction of travel deg)
GAITS = {
    "idle": (0.0, 0.0, 0.0),
    "creep": (0.3, 0.0, 0.0),
    "walk": (1.35, 0.0, 0.0),
    "changing over": (2.1, 0.0, 0.0),
    "run": (3.6, 0.0, 0.0),
    "sprint": (7.5, 0.0, 0.0),
    "turn on the spot": (0.0, 75.0, 0.0),
    "walk in a circle": (1.0, 50.0, 0.0),
    "tight bend": (2.0, -100.0, 0.0),
    "run in a bend": (3.0, 100.0, 0.0),
    "backward": (0.9, 0.0, 180.0),
    "side step": (0.6, 0.0, 90.0),
    "diagonal in a bend": (0.8, 30.0, -45.0),
}
PATHS = {
    **{
        name: straight_or_arc(speed, radians(turn), 4.0, travel_angle_rad=radians(travel))
        for name, (speed, turn, travel) in GAITS.items()
    },
    "start and stop": start_and_stop(1.4, wait_s=0.7, ramp_s=0.8, cruise_s=2.0, turn_rate_rad_s=radians(40)),
    "start to run": start_and_stop(3.5, wait_s=0.5, ramp_s=1.5, cruise_s=1.5),
    "straight, then a bend": RootPath((PathSegment(2.0, 2.0), PathSegment(3.0, 2.0, radians(50)))),
}
every_path = pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)


def times_of(clip: Clip) -> Floats:
    return np.arange(clip.frame_count) / clip.frame_rate_hz


def heading_of(clip: Clip) -> Floats:
    forward = quaternions.rotate_vectors(clip.rotations[:, 0].astype(np.float64), (0.0, 0.0, 1.0))
    return np.unwrap(np.arctan2(forward[:, 0], forward[:, 2]))


@pytest.mark.parametrize(("speed", "turn_deg", "travel_deg"), GAITS.values(), ids=GAITS)
def test_the_root_follows_the_arc_of_its_speed_and_turn_rate_exactly(
    speed: float, turn_deg: float, travel_deg: float
) -> None:
    omega, travel = radians(turn_deg), radians(travel_deg)
    clip = generate_gait(speed, omega, 10.0, RATE_HZ, travel_angle_rad=travel)

    t = times_of(clip)
    if omega:
        x = speed / omega * (np.cos(travel) - np.cos(omega * t + travel))
        z = speed / omega * (np.sin(omega * t + travel) - np.sin(travel))
    else:
        x, z = speed * t * np.sin(travel), speed * t * np.cos(travel)
    assert clip.frame_count == 600
    assert np.abs(clip.root_translations[:, 0] - x).max() < FLOAT32_M * (1 + speed)
    assert np.abs(clip.root_translations[:, 2] - z).max() < FLOAT32_M * (1 + speed)
    assert np.abs(heading_of(clip) - omega * t).max() < 1e-6


def test_a_turn_to_the_left_goes_to_positive_x() -> None:
    clip = generate_gait(1.0, radians(30), 3.0)

    assert clip.root_translations[-1, 0] > 1.0
    assert heading_of(clip)[-1] > radians(88)


def test_the_axis_through_both_hips_is_square_to_the_heading() -> None:
    clip = generate_gait(1.5, radians(40), 4.0)
    skeleton = clip.skeleton
    positions = kinematics.global_positions(clip)

    directions = kinematics.forward_directions(
        positions, [skeleton.index_of("LeftUpLeg")], [skeleton.index_of("RightUpLeg")]
    )
    assert np.abs(kinematics.headings(directions) - radians(40) * times_of(clip)).max() < 1e-5


@every_path
def test_the_root_is_where_its_path_says(path: RootPath) -> None:
    clip = generate_along(path)

    state = path.at(times_of(clip))
    assert np.abs(clip.root_translations[:, 2] - state.positions.real).max() < 2e-5
    assert np.abs(clip.root_translations[:, 0] - state.positions.imag).max() < 2e-5
    assert np.abs(heading_of(clip) - state.headings).max() < 1e-6


@every_path
def test_a_path_is_the_integral_of_its_velocity(path: RootPath) -> None:
    t = np.linspace(-1.0, path.duration_s + 1.0, 200_001)
    state = path.at(t)

    steps = np.diff(t)
    way = np.cumsum(0.5 * (state.velocities[1:] + state.velocities[:-1]) * steps)
    turned = np.cumsum(state.turn_rates[:-1] * steps)
    assert np.abs(state.positions[1:] - state.positions[0] - way).max() < 1e-4
    assert np.abs(state.headings[1:] - state.headings[0] - turned).max() < 1e-4


def test_a_hardly_noticeable_turn_is_the_limit_of_going_straight() -> None:
    t = np.linspace(0.0, 30.0, 301)
    ramp = {"end_speed_m_s": 3.0}

    straight = straight_or_arc(1.0, 0.0, 30.0, **ramp).at(t).positions
    bent = straight_or_arc(1.0, 1e-9, 30.0, **ramp).at(t).positions
    assert np.abs(bent - straight).max() < 2e-6


def test_the_upper_body_rides_rigidly_on_the_root_when_its_motions_are_switched_off() -> None:
    style = GaitStyle(bounce=0.0, lean=0.0, sway=0.0, arm_swing=0.0)
    clip = generate_gait(1.35, radians(50), 4.0, style=style)

    chest = clip.skeleton.index_of("Spine2")
    positions = kinematics.global_positions(clip)[:, chest]
    state = straight_or_arc(1.35, radians(50), 4.0).at(times_of(clip))
    ahead = (positions[:, 2] + 1j * positions[:, 0] - state.positions) * np.exp(-1j * state.headings)
    assert np.abs(ahead - ahead[0]).max() < 1e-5


@every_path
def test_planted_feet_do_not_slide(path: RootPath) -> None:
    clip = generate_along(path)
    skeleton = clip.skeleton
    truth = foot_motions(path, times_of(clip))
    positions = kinematics.global_positions(clip).astype(np.float64)
    rotations = kinematics.global_rotations(clip).astype(np.float64)

    for side, foot in truth.items():
        ball = positions[:, skeleton.index_of(f"{side}ToeBase")]
        turned = quaternions.rotate_vectors(rotations[:, skeleton.index_of(f"{side}Foot")], (0.0, 0.0, 1.0))
        heel = ball - 0.185 * turned
        for point, planted in ((ball, foot.ball_planted), (heel, foot.heel_planted)):
            both = planted[1:] & planted[:-1]
            assert both.mean() > 0.05
            steps = np.linalg.norm(np.diff(point, axis=0), axis=1)[both]
            assert steps.max() < 5e-5
            assert np.abs(point[planted, 1] - 0.02).max() < 5e-5


@every_path
def test_a_foot_stays_within_a_millimetre_during_each_whole_stance(path: RootPath) -> None:
    clip = generate_along(path)
    truth = foot_motions(path, times_of(clip))
    positions = kinematics.global_positions(clip).astype(np.float64)

    for side, foot in truth.items():
        ball = positions[:, clip.skeleton.index_of(f"{side}ToeBase")]
        edges = np.flatnonzero(np.diff(foot.ball_planted)) + 1
        for stance in np.split(np.arange(len(ball)), edges):
            if foot.ball_planted[stance[0]]:
                assert np.ptp(ball[stance], axis=0).max() < 1e-3


@every_path
def test_nothing_is_below_the_floor(path: RootPath) -> None:
    clip = generate_along(path, style=GaitStyle.varied(3))

    assert kinematics.global_positions(clip, end_sites=True)[..., 1].min() > 0.0199


@every_path
def test_nothing_jumps_between_frames(path: RootPath) -> None:
    clip = generate_along(path, 240.0, style=GaitStyle.varied(5))

    positions = kinematics.global_positions(clip, end_sites=True).astype(np.float64)
    accelerations = np.diff(positions, 2, axis=0) * 240.0**2
    fastest = path.at(times_of(clip)).speeds.max()
    assert np.linalg.norm(accelerations, axis=-1).max() < 300.0 * (1.0 + fastest)
    turns = quaternions.angle_between(clip.rotations[1:].astype(float), clip.rotations[:-1].astype(float))
    assert np.degrees(turns.max()) < 10.0
    assert np.sum(clip.rotations[1:] * clip.rotations[:-1], axis=-1).min() > 0.0


@every_path
def test_knees_bend_forward_only(path: RootPath) -> None:
    clip = generate_along(path)

    for side in ("Left", "Right"):
        knee = clip.rotations[:, clip.skeleton.index_of(f"{side}Leg")].astype(np.float64)
        angles = quaternions.as_rotation_vector(knee)
        assert angles[:, 0].min() > 0.0
        assert np.abs(angles[:, 1:]).max() < 1e-3


def test_a_faster_gait_takes_longer_strides_and_runs_have_a_flight() -> None:
    for speed, flies in ((1.2, False), (3.5, True)):
        truth = foot_motions(straight_or_arc(speed, 0.0, 8.0), np.arange(480) / 60.0)
        in_air = ~np.any([foot.ball_planted | foot.heel_planted for foot in truth.values()], axis=0)
        assert in_air.any() == flies


def test_someone_standing_still_keeps_both_feet_down() -> None:
    truth = foot_motions(straight_or_arc(0.0, 0.0, 4.0), np.arange(240) / 60.0)

    assert all(foot.ball_planted.all() and foot.heel_planted.all() for foot in truth.values())


def test_a_smaller_body_walks_the_same_path() -> None:
    path = PATHS["walk in a circle"]
    small = generate_along(path, stature_m=1.2)

    assert np.abs(small.root_translations[:, 0] - path.at(times_of(small)).positions.imag).max() < 2e-5
    truth = foot_motions(path, times_of(small), stature_m=1.2)["Left"]
    ball = kinematics.global_positions(small)[:, small.skeleton.index_of("LeftToeBase")]
    assert np.abs(ball - truth.balls)[truth.ball_planted].max() < 2e-5
    assert small.skeleton is studio_skeleton(1.2)
    assert 0.55 < small.root_translations[:, 1].min() < small.root_translations[:, 1].max() < 0.66
    assert kinematics.global_positions(small, end_sites=True)[..., 1].min() > 0.0134


@pytest.mark.parametrize("stride", [0.0, -1.0, float("nan")])
def test_strides_need_a_length(stride: float) -> None:
    with pytest.raises(MotionError, match="strides must be above 0"):
        GaitStyle(stride=stride)


def test_the_same_arguments_give_the_same_bytes_and_other_styles_others() -> None:
    def bytes_of(seed: int) -> bytes:
        return generate_gait(1.4, 0.3, 3.0, style=GaitStyle.varied(seed)).poses.tobytes()

    assert bytes_of(7) == bytes_of(7)
    assert bytes_of(7) != bytes_of(8)


def test_style_changes_the_body_but_never_the_root() -> None:
    plain, styled = (generate_gait(1.4, 0.3, 3.0, style=style) for style in (None, GaitStyle.varied(11)))

    assert np.array_equal(plain.root_translations[:, ::2], styled.root_translations[:, ::2])
    assert np.abs(plain.rotations - styled.rotations).max() > 0.01


def test_the_dataset_holds_two_dozen_named_takes_of_many_kinds() -> None:
    takes = generate_dataset(seed=1)

    assert len(takes) == 24
    assert len({take.name for take in takes}) == 24
    assert {"walk", "run", "turn", "left", "right", "idle"} <= {tag for take in takes for tag in take.tags}
    assert all(take.clip.skeleton.joint_names == takes[0].clip.skeleton.joint_names for take in takes)
    again = generate_dataset(seed=1)
    assert [take.clip.poses.tobytes() for take in takes] == [take.clip.poses.tobytes() for take in again]


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        ((-1.0, 0.0, 2.0), "speed_m_s"),
        ((float("nan"), 0.0, 2.0), "speed_m_s"),
        ((1.0, float("inf"), 2.0), "turn_rate_rad_s"),
        ((1.0, 0.0, 0.0), "duration_s"),
        ((1.0, 0.0, 1e9), "duration_s"),
        ((1.0, 0.0, 2.0, 0.0), "frame_rate_hz"),
        ((60.0, 0.0, 2.0), "speed_m_s"),
    ],
)
def test_an_impossible_gait_is_refused_by_the_name_of_its_parameter(arguments: tuple[Any, ...], place: str) -> None:
    with pytest.raises(MotionError) as error:
        generate_gait(*arguments)
    assert error.value.where == place


def test_a_single_frame_and_a_slow_frame_rate_are_possible() -> None:
    assert generate_gait(1.0, 0.0, 1.0, 1.0).frame_count == 1
    assert generate_gait(1.0, 0.0, 10.0, 0.5).frame_count == 5


def test_a_stature_must_be_positive() -> None:
    with pytest.raises(MotionError, match="positive"):
        generate_gait(1.0, 0.0, 1.0, stature_m=0.0)


def test_the_game_skeleton_is_a_mirror_image_of_itself_and_stands_on_the_floor() -> None:
    skeleton = game_skeleton()
    positions = skeleton.rest_global_positions

    for name in skeleton.joint_names:
        if name.endswith("_l"):
            left, right = positions[skeleton.index_of(name)], positions[skeleton.index_of(f"{name[:-1]}r")]
            assert left == pytest.approx(right * (-1.0, 1.0, 1.0), abs=1e-12)
    assert positions[skeleton.index_of("ball_l"), 1] == pytest.approx(0.02)
    assert positions[skeleton.index_of("head"), 1] > 1.6
    turns = quaternions.angle_between(skeleton.rest_global_rotations, quaternions.identity())
    assert turns.min() > pi / 4
