"""The edit commands `constrain` and `plant_feet`, from the JSON of a command to the resulting poses."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.errors import MotionError
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.motion import Motion
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.edits import EditDocument


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.2, 0.2, 2.0)


@pytest.fixture(scope="module")
def game_walk(walk: Clip) -> Clip:
    """The same walk on a skeleton with other names, proportions and local axes."""
    target = game_skeleton()
    rigs = [(one, map_joints(one), guess_axes(one, map_joints(one))) for one in (walk.skeleton, target)]
    return retarget(walk, plan_retarget(*rigs[0], *rigs[1]))


def _edited(clip: Clip, *commands: dict[str, Any]) -> EditedClip:
    """Return the result of commands that were stored as JSON and read again."""
    document = EditDocument.model_validate({"commands": commands})
    again = EditDocument.model_validate_json(json.dumps(document.model_dump(mode="json", by_alias=True)))
    assert again == document
    return edit_clip(clip, again.commands)[0]


def _constrain(*constraints: dict[str, Any], **options: Any) -> dict[str, Any]:
    return {"command": "constrain", "constraints": constraints, **options}


def _places(clip: Clip, standard: str) -> np.ndarray:
    joint = map_joints(clip.skeleton).indices(clip.skeleton, (standard,))[0]
    return kinematics.global_positions(clip)[:, joint].astype(np.float64)


@pytest.mark.parametrize("which", ["walk", "game_walk"])
def test_a_wrist_is_shifted_over_a_range_on_every_skeleton(request: pytest.FixtureRequest, which: str) -> None:
    clip: Clip = request.getfixturevalue(which)
    edited = _edited(
        clip, _constrain({"kind": "position", "joint": "left_wrist", "frames": [40, 60], "shift_m": [0.02, 0.1, 0.05]})
    )
    moved = _places(edited.clip, "left_wrist") - _places(clip, "left_wrist")
    np.testing.assert_allclose(moved[40:60], np.tile((0.02, 0.1, 0.05), (20, 1)), atol=1e-3)
    outside = np.r_[0:22, 78 : clip.frame_count]
    assert edited.clip.poses[outside].tobytes() == clip.poses[outside].tobytes()
    (found,) = edited.findings[0].values["constraints"]
    assert found["residual_before_m"] == pytest.approx(np.linalg.norm((0.02, 0.1, 0.05)), rel=1e-6)
    assert found["residual_after_m"] < 1e-6
    assert found["frames"] == found["frames_reached"] == 20


def test_a_joint_is_held_where_it_first_is_and_replays_in_the_same_bytes(walk: Clip) -> None:
    held = _constrain({"kind": "position", "joint": "LeftHand", "frames": [30, 50]})
    first, again = (_edited(walk, held).clip for _ in range(2))
    places = _places(first, "left_wrist")
    assert np.ptp(places[30:50], axis=0).max() < 1e-5
    np.testing.assert_allclose(places[30], _places(walk, "left_wrist")[30], atol=1e-5)
    assert first.poses.tobytes() == again.poses.tobytes()


def test_a_foot_is_held_by_its_height_alone(walk: Clip) -> None:
    edited = _edited(
        walk,
        _constrain(
            {"kind": "position", "joint": "right_ankle", "frames": [40, 70], "point_m": [0, 0.3, 0], "axes": "y"}
        ),
    ).clip
    assert np.abs(_places(edited, "right_ankle")[40:70, 1] - 0.3).max() < 2e-4


def test_an_orientation_is_reached_and_held(walk: Clip) -> None:
    wanted = quaternions.from_rotation_vector((0.1, 0.5, 1.2))
    edited = _edited(
        walk,
        _constrain(
            {"kind": "orientation", "joint": "head", "frames": [40, 50], "rotation": wanted.tolist(), "top": "neck"},
            {"kind": "orientation", "joint": "right_wrist", "frames": [80, 100]},
        ),
    ).clip
    spins = kinematics.global_rotations(edited)
    head, wrist = map_joints(walk.skeleton).indices(walk.skeleton, ("head", "right_wrist"))
    assert quaternions.angle_between(spins[40:50, head], wanted).max() < 2e-3
    assert quaternions.angle_between(spins[80:100, wrist], kinematics.global_rotations(walk)[80, wrist]).max() < 2e-3


@pytest.mark.parametrize("which", ["walk", "game_walk"])
def test_a_head_looks_with_its_front_and_an_arm_points_along_its_bone(
    request: pytest.FixtureRequest, which: str
) -> None:
    clip: Clip = request.getfixturevalue(which)
    point = np.array([3.0, 1.2, 3.0])
    look = {"kind": "look_at", "frames": [50, 60], "point_m": point.tolist()}
    edited = _edited(
        clip,
        _constrain({**look, "joint": "head", "top": "neck"}, {**look, "joint": "right_elbow", "top": "right_elbow"}),
    ).clip
    skeleton = clip.skeleton
    head, elbow, wrist = map_joints(skeleton).indices(skeleton, ("head", "right_elbow", "right_wrist"))
    positions = kinematics.global_positions(edited)[50:60].astype(np.float64)
    axes = guess_axes(skeleton, map_joints(skeleton), clip)[skeleton.joint_names[head]]
    front = np.cross(axes.swing, axes.twist)
    gaze = quaternions.rotate_vectors(kinematics.global_rotations(edited)[50:60, head], front)

    def angles(directions: np.ndarray, joint: int) -> np.ndarray:
        way = point - positions[:, joint]
        cosines = np.sum(directions * way, axis=1) / np.linalg.norm(directions, axis=1) / np.linalg.norm(way, axis=1)
        return np.arccos(np.clip(cosines, -1.0, 1.0))

    assert angles(gaze, head).max() < 5e-3
    assert angles(positions[:, wrist] - positions[:, elbow], elbow).max() < 0.05


@pytest.mark.parametrize("solver", ["ccd", "least_squares", "two_bone"])
def test_every_solver_can_be_named(walk: Clip, solver: str) -> None:
    near = (_places(walk, "left_shoulder")[60] + (0.1, -0.1, 0.3)).tolist()
    edited = _edited(
        walk,
        _constrain({"kind": "position", "joint": "left_wrist", "frames": [60, 61], "point_m": near}, solver=solver),
    )
    assert np.linalg.norm(_places(edited.clip, "left_wrist")[60] - near) < 2e-4


def test_limits_and_stiffness_by_standard_names_hold(walk: Clip) -> None:
    near = (_places(walk, "left_shoulder")[60] + (0.1, 0.0, 0.1)).tolist()
    limits = [
        {"kind": "hinge", "joint": "left_elbow", "angle_deg": [-60, 0]},
        {"kind": "cone", "joint": "left_shoulder", "swing_deg": [120, 120], "twist_deg": [-90, 90]},
    ]
    wanted = {"kind": "position", "joint": "left_wrist", "frames": [60, 70], "point_m": near}
    edited = _edited(walk, _constrain(wanted, limits=limits, stiffness={"left_wrist": 0.5})).clip
    elbow = walk.skeleton.index_of("LeftForeArm")
    turned = quaternions.multiply(
        quaternions.conjugate(walk.skeleton.rest_rotations[elbow]), Motion.of(edited).rotations[60:70, elbow]
    )
    assert quaternions.angle_between(quaternions.identity(10), turned).max() <= np.radians(60.001)


def test_the_root_moves_when_it_may(walk: Clip) -> None:
    far = {"kind": "position", "joint": "left_wrist", "frames": [60, 62], "point_m": [5.0, 1.0, 5.0], "top": "root"}
    held, moved = (_edited(walk, _constrain(far, root_moves=moves)) for moves in (False, True))
    assert held.findings[0].values["constraints"][0]["frames_reached"] == 0
    assert moved.findings[0].values["constraints"][0]["frames_reached"] == 2


def test_feet_are_planted_where_contacts_are_given_or_found(walk: Clip) -> None:
    motion = Motion.of(walk)
    t = np.arange(walk.frame_count) / walk.frame_rate_hz
    sliding = motion._replace(root_translations=motion.root_translations + 0.02 * np.sin(3.0 * t)[:, None])
    clip = sliding.as_clip(walk.skeleton, walk.frame_rate_hz)
    found = _edited(clip, {"command": "plant_feet"})
    values = found.findings[0].values
    assert values["slide_after_m"] < 0.05 * values["slide_before_m"]
    given = _edited(clip, {"command": "plant_feet", "contacts": [{"foot": "left", "frames": [66, 86]}], "blend_s": 0.1})
    toes = _places(given.clip, "left_toe")
    assert np.ptp(toes[66:86], axis=0).max() < 1e-3
    assert given.clip.poses[:59].tobytes() == clip.poses[:59].tobytes()


def test_what_is_no_body_can_be_constrained_but_has_no_front_and_no_feet(tumbling: Callable[..., Clip]) -> None:
    names = tuple(f"part{number}" for number in range(8))
    crane = Skeleton(names, np.arange(-1, 7, dtype=np.int32), np.tile((0.0, 0.3, 0.0), (8, 1)), quaternions.identity(8))
    clip = tumbling(crane, 40)
    moved = _edited(
        clip, _constrain({"kind": "position", "joint": "part7", "frames": [10, 20], "shift_m": [0, 0.02, 0]})
    )
    assert moved.findings[0].values["constraints"][0]["frames_reached"] >= 9
    look = {"kind": "look_at", "joint": "part7", "frames": [10, 20], "point_m": [0, 1, 0]}
    with pytest.raises(MotionError, match="alternatively, set the axis"):
        _edited(clip, _constrain(look))
    assert _edited(clip, _constrain({**look, "axis": [0, 1, 0]})).findings
    with pytest.raises(MotionError, match="plant_feet"):
        _edited(clip, {"command": "plant_feet"})


@pytest.mark.parametrize(
    ("constraint", "says"),
    [
        ({"kind": "position", "joint": "left_wirst"}, r"constraints\[0\].*left_wirst"),
        (
            {"kind": "position", "joint": "left_wrist", "frames": [110, 130]},
            "the range 110:130 must be within",
        ),
        ({"kind": "position", "joint": "left_wrist", "top": "right_shoulder"}, "is not an ancestor of"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_by_place(walk: Clip, constraint: dict[str, Any], says: str) -> None:
    with pytest.raises(MotionError, match=says) as raised:
        _edited(walk, {"command": "trim"}, _constrain(constraint))
    assert "commands[1] (constrain)" in str(raised.value)


@pytest.mark.parametrize(
    "bad",
    [
        _constrain(),
        _constrain({"kind": "position", "joint": "a", "point_m": [0, 0, 0], "shift_m": [0, 0, 0]}),
        _constrain({"kind": "position", "joint": "a", "point_m": [0, float("inf"), 0]}),
        _constrain({"kind": "orientation", "joint": "a", "rotation": [1, 1, 0, 0]}),
        _constrain({"kind": "look_at", "joint": "a", "point_m": [0, 0, 0], "axis": [0, 0, 0]}),
        _constrain({"kind": "turn", "joint": "a"}),
        _constrain({"kind": "position", "joint": "a"}, limits=[{"kind": "hinge", "joint": "a", "angle_deg": [9, 3]}]),
        _constrain({"kind": "position", "joint": "a"}, stiffness={"a": 1.0}),
        {"command": "plant_feet", "contacts": [{"foot": "third", "frames": [0, 3]}]},
        {"command": "plant_feet", "blend_s": -1},
    ],
)
def test_documents_that_make_no_sense_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        EditDocument.model_validate({"commands": [bad]})
