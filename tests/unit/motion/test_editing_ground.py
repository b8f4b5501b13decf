"""The ground, and the position of feet on it. The soles of the generated body are 2 cm below its lowest joints."""

from dataclasses import replace
from math import degrees
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.edited_takes import make_walk

from marey_motion.clip import Clip
from marey_motion.editing.registry import apply_edit, edit_clip
from marey_motion.gait import foot_motions, generate_along, straight_or_arc
from marey_motion.kinematics import global_positions
from marey_schemas.editing.commands import FindContacts, FindGround, MoveToGround, RotateJoint, Translate


def lifted(clip: Clip, height_m: float) -> Clip:
    return apply_edit(clip, [Translate(shift_m=(0.0, height_m, 0.0))])


def height_of(clip: Clip) -> float:
    (made,) = edit_clip(clip, [FindGround()])
    (finding,) = made.findings
    assert finding.values["standing_frames"] > 0
    return float(finding.values["height_m"])


@pytest.mark.parametrize("height_m", [-1.3, 0.0, 0.17, 12.0])
@pytest.mark.parametrize("speed_m_s", [0.0, 1.3, 3.0])
def test_the_ground_is_found_wherever_it_is(height_m: float, speed_m_s: float) -> None:
    assert height_of(lifted(make_walk(speed_m_s=speed_m_s), height_m)) == pytest.approx(height_m, abs=0.025)


def test_a_foot_below_the_floor_for_some_frames_does_not_move_the_ground() -> None:
    walk = make_walk()
    poses = walk.poses.copy()
    poses[80:90, 1] -= 0.3
    assert height_of(replace(walk, poses=poses)) == pytest.approx(height_of(walk), abs=0.01)


def test_moving_to_the_ground_brings_it_to_height_zero() -> None:
    (made,) = edit_clip(lifted(make_walk(), 0.4), [MoveToGround()])
    assert made.findings[0].values["height_m"] == pytest.approx(0.4, abs=0.025)
    assert height_of(made.clip) == pytest.approx(0.0, abs=1e-5)


def test_a_given_height_is_gone_by() -> None:
    walk = make_walk()
    moved = apply_edit(walk, [MoveToGround(height_m=0.25)])
    assert np.allclose(global_positions(walk)[..., 1] - global_positions(moved)[..., 1], 0.25, atol=1e-5)


def test_contacts_are_those_of_the_feet_that_stand() -> None:
    path = straight_or_arc(1.3, 0.0, 4.0)
    walk = generate_along(path, 60.0)
    (made,) = edit_clip(walk, [FindContacts()])
    assert np.array_equal(made.clip.poses, walk.poses)
    (finding,) = made.findings
    truth = foot_motions(path, np.arange(walk.frame_count) / 60.0)
    for side in ("Left", "Right"):
        found = np.zeros(walk.frame_count, dtype=bool)
        for one in finding.values["segments"]:
            assert one["start"] < one["end"]
            if one["label"] == f"{side.lower()}_foot":
                found[one["start"] : one["end"]] = True
        stands = truth[side].heel_planted | truth[side].ball_planted
        assert np.mean(found == stands) > 0.9


def test_a_foot_that_is_held_in_the_air_does_not_stand_on_the_ground() -> None:
    standing = make_walk(speed_m_s=0.0)
    lift = [
        RotateJoint(joint=joint, axis=(1.0, 0.0, 0.0), angle_deg=degrees(angle), border_s=0.0)
        for joint, angle in (("LeftUpLeg", -1.2), ("LeftLeg", 1.2))
    ]

    def labels(**given: Any) -> set[str]:
        (made,) = edit_clip(standing, [*lift, FindContacts(**given)])
        return {one["label"] for one in made.findings[0].values["segments"]}

    assert labels() == {"right_foot"}
    assert labels(height_limit_m=None) == {"left_foot", "right_foot"}


def test_where_no_foot_stands_the_lowest_point_tells() -> None:
    walk = make_walk()
    poses = walk.poses.copy()
    poses[:, 0] += np.arange(walk.frame_count) * 0.1  # carried along at 6 m/s
    (made,) = edit_clip(replace(walk, poses=poses), [FindGround()])
    assert made.findings[0].values["standing_frames"] == 0
    assert made.findings[0].values["height_m"] == pytest.approx(0.0, abs=0.03)


def test_a_limit_must_be_positive() -> None:
    with pytest.raises(ValidationError, match="speed_m_s"):
        apply_edit(make_walk(), [FindContacts(speed_m_s=0.0)])
