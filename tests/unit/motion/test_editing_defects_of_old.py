"""Published defects of other motion editors, one test for each."""

from math import degrees

import numpy as np
import pytest
from tests.support.edit_examples import examples_of
from tests.support.edited_takes import make_breathing_walk, make_walk, require_sound, same_poses

from marey_motion.clip import Clip
from marey_motion.editing.registry import apply_edit, edit_clip
from marey_motion.gait import game_skeleton, studio_skeleton
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.commands import EXAMPLE_SOURCE, FindGround, Mirror, Paste, RotateJoint, Smooth, Translate
from marey_schemas.editing.edits import COMMAND_MODELS, EditDocument


def test_guess_ground_height_tells_a_height_instead_of_a_name_error() -> None:
    raised = apply_edit(make_walk(), [Translate(shift_m=(0.0, 0.8, 0.0))])
    (made,) = edit_clip(raised, [FindGround()])
    assert made.findings[0].values["height_m"] == pytest.approx(0.8, abs=0.025)


HISTORY = (
    "rotate_joint",  # rotate_joint
    "mirror",  # mirror
    "constrain",  # translate_joint, and fix_joint, by inverse kinematics
    "plant_feet",
    "trim",  # delete_before, delete_after
    "smooth",  # smooth
    "resample",  # resample
    "rotate",  # rotate_frames
    "translate",  # translate_frames
)


@pytest.mark.parametrize("name", HISTORY)
def test_every_command_of_an_edit_history_replays_from_its_json(name: str) -> None:
    walk, other = make_breathing_walk(), make_walk(speed_m_s=2.0)
    document = EditDocument.model_validate({"commands": examples_of(name)})
    replayed = EditDocument.model_validate_json(document.model_dump_json(by_alias=True))
    once, again = (
        edit_clip(walk, one.commands, sources={EXAMPLE_SOURCE: other})[0].clip for one in (document, replayed)
    )
    assert once.poses.tobytes() == again.poses.tobytes()
    assert once.poses.shape != walk.poses.shape or not np.array_equal(once.poses, walk.poses)


def test_an_edit_history_can_be_taken_back_step_by_step() -> None:
    """The commands are stored, not the frames: omitting the last command undoes it, and adding it again redoes it."""
    walk = make_walk()
    history = [COMMAND_MODELS[name](**COMMAND_MODELS[name].examples[0]) for name in HISTORY]
    states = [walk, *(apply_edit(walk, history[: number + 1]) for number in range(len(history)))]
    for command, undone, done in zip(history, states, states[1:], strict=False):
        assert same_poses(apply_edit(undone, [command]), done, 1e-5), command
        assert not same_poses(undone, done, 1e-3), command


def pose_with_raised_hand(skeleton: Skeleton, arm: str) -> Clip:
    pose = np.concatenate((skeleton.offsets[0], skeleton.rest_rotations.ravel())).astype(np.float32)
    still = Clip(skeleton, 30.0, np.tile(pose, (10, 1)))
    turn = RotateJoint(joint=arm, axis=(0.0, 0.0, 1.0), angle_deg=degrees(0.9), space="world", border_s=0.0)
    return apply_edit(still, [turn])


@pytest.mark.parametrize(
    ("skeleton", "arm", "hands"),
    [
        (studio_skeleton(), "LeftArm", ("LeftHand", "RightHand")),
        (game_skeleton(), "upperarm_l", ("hand_l", "hand_r")),
    ],
    ids=["studio", "game"],
)
def test_mirroring_is_not_for_the_joint_names_of_one_skeleton(
    skeleton: Skeleton, arm: str, hands: tuple[str, str]
) -> None:
    raised = pose_with_raised_hand(skeleton, arm)
    left, right = map(skeleton.index_of, hands)
    before, after = global_positions(raised), global_positions(apply_edit(raised, [Mirror()]))
    assert np.allclose(after[:, right], before[:, left] * [-1.0, 1.0, 1.0], atol=1e-3)
    assert np.allclose(after[:, left], before[:, right] * [-1.0, 1.0, 1.0], atol=1e-3)


@pytest.mark.parametrize("window_s", [0.1, 0.5, 1.5])
def test_smoothing_keeps_the_last_frame_and_unit_quaternions(window_s: float) -> None:
    walk = make_walk(turn_rate_rad_s=1.0)
    smoothed = apply_edit(walk, [Smooth(method="gaussian", window_s=window_s)])
    assert smoothed.frame_count == walk.frame_count
    assert np.allclose(smoothed.poses[-1], walk.poses[-1], atol=1e-6)
    require_sound(smoothed)


def test_a_change_of_a_range_does_not_leak_out_of_it() -> None:
    walk = make_breathing_walk()
    for command in (
        Smooth(window_s=0.3, frames=(60, 100)),
        RotateJoint(joint="Head", axis=(1.0, 0.0, 0.0), angle_deg=degrees(0.5), frames=(60, 100)),
        Paste(source=EXAMPLE_SOURCE, joints=["LeftArm"], frames=(60, 100)),
    ):
        changed = apply_edit(walk, [command], sources={EXAMPLE_SOURCE: make_walk(speed_m_s=2.0)})
        assert np.array_equal(changed.poses[:60], walk.poses[:60]), command
        assert np.array_equal(changed.poses[100:], walk.poses[100:]), command
        assert not np.array_equal(changed.poses[60:100], walk.poses[60:100]), command
