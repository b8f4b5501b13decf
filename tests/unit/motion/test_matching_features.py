import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.plain_features import plain_rows

from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import GaitStyle, generate_along, generate_gait, start_and_stop, studio_skeleton
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.features import feature_layout
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import DatabaseOptions, FeatureWeights

DEFAULTS = DatabaseOptions()
BODY = MatchingBody.from_mapping(studio_skeleton(), map_joints(studio_skeleton()))


def built(clip: Clip, options: DatabaseOptions = DEFAULTS) -> MatchingDatabase:
    return build_database([SourceClip("one", "one", clip)], BODY, options)


def moved(clip: Clip) -> Clip:
    """Return the clip with a spine and a wrist that move relative to their parents."""
    joints = tuple(sorted(BODY.standard_joints[name] for name in ("spine", "left_wrist")))
    seconds = np.arange(clip.frame_count)[:, None, None] / 60.0
    translations = clip.skeleton.offsets[list(joints)] + 0.02 * np.sin(3.0 * seconds + np.arange(6).reshape(2, 3))
    return replace(clip, translations=translations.astype(np.float32), translated_joints=joints)


CLIPS: dict[str, Callable[[], Clip]] = {
    "walk to the left": lambda: generate_gait(1.3, 0.7, 3.0, style=GaitStyle.varied(3)),
    "run to the right": lambda: generate_gait(3.4, -0.6, 2.5, style=GaitStyle.varied(5)),
    "sideways": lambda: generate_gait(0.6, 0.0, 2.0, travel_angle_rad=np.pi / 2),
    "on the spot": lambda: generate_gait(0.0, -1.0, 8.0),
    "start and stop": lambda: generate_along(start_and_stop(1.35, wait_s=0.5, ramp_s=0.6, cruise_s=1.0)),
    "joints that move": lambda: moved(generate_gait(1.3, 0.7, 2.0)),
    **{
        f"{frames} frames": functools.partial(generate_gait, 1.2, 0.4, frames / 60.0)
        for frames in (1, 2, 3, 4, 5, 6, 21)
    },
}


@functools.cache
def clip_named(name: str) -> Clip:
    """Return a clip of `CLIPS`, which is only made if a test uses it: each test process imports this module."""
    return CLIPS[name]()


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("name", CLIPS)
def test_rows_are_those_of_plain_loops(name: str) -> None:
    clip = clip_named(name)
    database, plain = built(clip), plain_rows(clip, BODY)
    np.testing.assert_allclose(database.features, plain.features, atol=1e-9)
    np.testing.assert_allclose(database.root_positions, plain.positions, atol=1e-11)
    np.testing.assert_allclose(database.root_headings, plain.headings, atol=1e-11)
    np.testing.assert_allclose(database.pose_points, plain.points, atol=1e-6)
    assert np.array_equal(database.contacts, plain.contacts)


def test_the_default_layout_has_27_dimensions_in_the_order_of_the_weights() -> None:
    layout = feature_layout(DatabaseOptions(), BODY)
    assert layout.dimension_count == 27
    assert layout.pose_dimensions == 15
    assert [group.name for group in layout.groups] == list(vars(FeatureWeights()))[:7]
    assert [(group.start, group.stop) for group in layout.groups] == [
        (0, 3), (3, 6), (6, 9), (9, 12), (12, 15), (15, 21), (21, 27)
    ]  # fmt: skip
    assert layout.names[0] == "left_foot_position.x"
    assert layout.names[17:19] == ("trajectory_positions.0.667s.x", "trajectory_positions.0.667s.z")


def test_a_walk_in_a_circle_says_so_in_its_trajectory() -> None:
    """Left is +x and forward is +z: the expected points lie on a left circle at 1.2 m/s and 0.5 rad/s."""
    database = built(generate_gait(1.2, 0.5, 6.0))
    inner = database.features[60:-120]
    for horizon, seconds in enumerate((1 / 3, 2 / 3, 1.0)):
        turn = 0.5 * seconds
        place = 1.2 / 0.5 * np.array([1 - np.cos(turn), np.sin(turn)])
        np.testing.assert_allclose(inner[:, 15 + 2 * horizon :][:, :2].mean(axis=0), place, atol=0.02)
        direction = np.array([np.sin(turn), np.cos(turn)])
        np.testing.assert_allclose(inner[:, 21 + 2 * horizon :][:, :2].mean(axis=0), direction, atol=0.02)
    assert inner[:, 14].mean() == pytest.approx(1.2, abs=0.02)
    assert (inner[:, 0] > inner[:, 3]).mean() > 0.9


def test_other_horizons_look_as_far_ahead_as_they_say() -> None:
    database = built(clip_named("walk to the left"), DatabaseOptions(horizons_s=(0.25, 0.5)))
    assert database.features.shape[1] == 15 + 8
    row, root = 30, (database.root_positions, database.root_headings)
    step = root[0][row + 30] - root[0][row]
    sine, cosine = np.sin(root[1][row]), np.cos(root[1][row])
    expected = [step[0] * cosine - step[1] * sine, step[0] * sine + step[1] * cosine]
    np.testing.assert_allclose(database.features[row, 17:19], expected, atol=1e-12)


def test_extra_joints_bring_their_position_and_velocity_between_hips_and_trajectory() -> None:
    database = built(clip_named("walk to the left"), DatabaseOptions(extra_joints=("left_wrist",)))
    plain = plain_rows(clip_named("walk to the left"), BODY)
    wrist = BODY.pose_joints.index(BODY.standard_joints["left_wrist"])
    assert database.layout.names[15:22:6] == ("left_wrist_position.x", "trajectory_positions.0.333s.x")
    np.testing.assert_allclose(database.features[:, 15:18], plain.points[:, wrist], atol=1e-9)
    np.testing.assert_allclose(database.features[:, 21:], plain.features[:, 15:], atol=1e-9)
    assert not [note for note in database.notes if note.code == "many-joints"]


def test_many_joints_are_warned_of() -> None:
    options = DatabaseOptions(extra_joints=("left_wrist", "right_wrist", "head"))
    notes = [note for note in built(clip_named("walk to the left"), options).notes if note.code == "many-joints"]
    assert [str(note) for note in notes] == [
        "6 joints are matched; with more than 5, the trajectory hardly affects the search; match fewer joints, or "
        "raise the weights of the trajectory"
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"extra_joints": ("head", "head")}, "extra_joints\n.*the joint 'head' more than once"),
        ({"horizons_s": ()}, "horizons_s"),
        ({"horizons_s": (0.5, 0.25)}, "horizons_s"),
        ({"horizons_s": (0.0, 0.25)}, "horizons_s"),
        ({"horizons_s": (0.005, 0.25)}, "horizons_s: .* one frame \\(1/60 s\\)"),
        ({"horizons_s": (0.25, 0.252)}, "horizons_s: .* one frame"),
        ({"horizons_s": (0.02,), "rate_hz": 20.0}, "horizons_s: .* one frame \\(1/20 s\\)"),
        ({"weights": {"hip_velocity": -1.0}}, "weights.hip_velocity"),
        ({"rate_hz": 0.0}, "rate_hz"),
    ],
)
def test_options_that_make_no_sense_are_refused_by_name(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        DatabaseOptions.model_validate(options)


def test_a_joint_that_the_skeleton_lacks_is_refused_by_name() -> None:
    with pytest.raises(MotionError, match="extra_joints: the joint mapping of the skeleton has no tail; it has head"):
        built(clip_named("5 frames"), DatabaseOptions(extra_joints=("tail",)))
