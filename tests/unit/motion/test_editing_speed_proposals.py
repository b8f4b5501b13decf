"""Proposed annotations of pauses, and of movements in which a hand reaches for something."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.annotations.layers import Layer
from marey_motion.editing.annotations.speed_proposals import propose_pauses, propose_reaches
from marey_motion.errors import MappingError
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs import map_joints
from marey_schemas.options.annotations import VelocityMinimaProposal, WristContactProposal

RATE_HZ = 60.0
RISE_S, HOLD_S = 1.0, 1.5


def raised(starts_s: list[float], *, joint: str = "RightArm", seconds: float = 10.0, heading_rad: float = 0.0) -> Clip:
    """Return a clip of a standing body that lifts an arm to the shoulder at each of the times `starts_s`.

    The body holds the arm sideways, then lowers it.
    """
    clip = generate_gait(0.0, 0.0, seconds, RATE_HZ)
    times = np.arange(clip.frame_count) / RATE_HZ
    lifted = np.zeros(clip.frame_count)
    for start in starts_s:
        up = np.clip((times - start) / RISE_S, 0, 1)
        down = np.clip((times - start - RISE_S - HOLD_S) / RISE_S, 0, 1)
        lifted += (1 - np.cos(np.pi * up)) / 2 - (1 - np.cos(np.pi * down)) / 2
    index = clip.skeleton.index_of(joint)
    side = 1.0 if joint.startswith("Right") else -1.0
    rotations = clip.rotations.astype(np.float64).copy()
    above = kinematics.global_rotations(clip)[:, clip.skeleton.parents[index]].astype(np.float64)
    turn = quaternions.from_axis_angle(np.array([0.0, 0.0, 1.0]), -side * 1.5 * lifted)
    rotations[:, index] = quaternions.multiply(
        quaternions.multiply(quaternions.conjugate(above), quaternions.multiply(turn, above)), rotations[:, index]
    )
    poses = np.concatenate([clip.root_translations, rotations.reshape(clip.frame_count, -1)], axis=1)
    return replace(clip, poses=poses.astype(np.float32))


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def test_each_raise_of_an_arm_is_a_reach_whose_contact_is_where_the_hand_arrives() -> None:
    clip = raised([1.0, 5.5])
    found = propose_reaches(clip, body_of(clip), WristContactProposal(release=True))
    assert [segment.label for segment in found.segments] == ["reach_right"] * 2
    for segment, start_s in zip(found.segments, (1.0, 5.5), strict=True):
        contact, release = [one for one in found.keyframes if segment.start <= one.frame < segment.end]
        assert (contact.label, release.label) == ("contact", "release")
        assert segment.start / RATE_HZ == pytest.approx(start_s, abs=0.3)
        assert contact.frame / RATE_HZ == pytest.approx(start_s + RISE_S, abs=0.3)
        assert release.frame / RATE_HZ == pytest.approx(start_s + RISE_S + HOLD_S, abs=0.3)
        assert segment.end / RATE_HZ == pytest.approx(start_s + 2 * RISE_S + HOLD_S, abs=0.3)


def test_the_hand_that_reaches_farther_is_found_and_the_other_on_request() -> None:
    clip = raised([2.0], joint="LeftArm")
    body = body_of(clip)
    assert [segment.label for segment in propose_reaches(clip, body).segments] == ["reach_left"]
    assert propose_reaches(clip, body, WristContactProposal(hand="right")) == Layer(clip.frame_count)


def test_a_hand_that_stays_reaches_nothing() -> None:
    clip = raised([])
    assert propose_reaches(clip, body_of(clip)) == Layer(clip.frame_count)


def test_walking_with_swinging_arms_is_no_reach() -> None:
    clip = generate_gait(1.2, 0.8, 8.0)
    assert propose_reaches(clip, body_of(clip), WristContactProposal(least_reach_m=0.7)) == Layer(clip.frame_count)


def test_a_skeleton_without_wrists_is_refused_by_the_joint() -> None:
    clip = raised([1.0])
    body = body_of(clip)
    known = {name: joint for name, joint in body.standard_joints.items() if name != "left_wrist"}
    with pytest.raises(MappingError, match="left_wrist"):
        propose_reaches(clip, replace(body, standard_joints=known))


def test_an_arm_pauses_where_it_is_held_and_movements_fill_the_clip() -> None:
    clip = raised([1.0])
    found = propose_pauses(clip, [clip.skeleton.index_of("RightHand")])
    (pause,) = found.keyframes
    assert 2.0 < pause.frame / RATE_HZ < 3.5
    assert [(one.label, one.start, one.end) for one in found.segments] == [
        ("movement", 0, pause.frame),
        ("movement", pause.frame, clip.frame_count),
    ]


def test_pauses_keep_their_distance() -> None:
    clip = generate_gait(1.4, 0.0, 6.0)
    near = propose_pauses(clip, options=VelocityMinimaProposal(least_depth=0.001, least_apart_s=0.02))
    far = propose_pauses(clip, options=VelocityMinimaProposal(least_depth=0.001, least_apart_s=1.0))
    frames = [one.frame for one in far.keyframes]
    assert len(near.keyframes) > len(far.keyframes)
    assert np.diff(frames).min() >= 60


def test_what_does_not_move_does_not_pause() -> None:
    clip = generate_gait(0.0, 0.0, 1.0).sliced(0, 1)
    still = replace(clip, poses=np.repeat(clip.poses, 50, axis=0))
    assert propose_pauses(still) == Layer(50)
    assert propose_pauses(clip) == Layer(1)


@pytest.mark.parametrize(
    ("options", "given", "where"),
    [
        (VelocityMinimaProposal, {"smoothing_s": 0.0}, "smoothing_s"),
        (WristContactProposal, {"least_reach_m": float("inf")}, "least_reach_m"),
        (WristContactProposal, {"arrived": 0.2}, "arrived"),
    ],
)
def test_options_that_make_no_sense_are_refused_by_name(options: Any, given: dict[str, float], where: str) -> None:
    with pytest.raises(ValidationError, match=where):
        options(**given)
