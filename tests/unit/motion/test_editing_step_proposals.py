"""Division of walks and runs into steps."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from math import radians
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import find_stances
from marey_motion.editing.annotations.layers import Layer
from marey_motion.editing.annotations.step_proposals import propose_steps
from marey_motion.gait import foot_motions, generate_along, generate_gait, start_and_stop, straight_or_arc
from marey_motion.matching.body import MatchingBody
from marey_motion.mirroring import mirror_clip
from marey_motion.rigs import map_joints
from marey_schemas.options.annotations import ContactOptions, StepsProposal


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def steps(clip: Clip, **options: Any) -> Layer:
    return propose_steps(clip, body_of(clip), StepsProposal(**options))


def count(layer: Layer) -> Counter[str]:
    return Counter(segment.label for segment in layer.segments)


@pytest.mark.parametrize("speed_m_s", [0.8, 1.4, 1.9])
def test_a_walk_is_cut_at_the_true_contacts_left_and_right_in_turn(speed_m_s: float) -> None:
    clip = generate_gait(speed_m_s, 0.0, 6.0)
    found = steps(clip)
    truth = foot_motions(straight_or_arc(speed_m_s, 0.0, 6.0), np.arange(clip.frame_count) / clip.frame_rate_hz)
    on_ground = {side: foot.heel_planted | foot.ball_planted for side, foot in truth.items()}
    strikes = {side: np.flatnonzero(~planted[:-1] & planted[1:]) + 1 for side, planted in on_ground.items()}
    assert len(found.segments) >= 6
    for segment in found.segments:
        swinging = segment.label.removeprefix("step_").capitalize()
        standing = {"Left": "Right", "Right": "Left"}[swinging]
        assert np.abs(strikes[swinging] - segment.end).min() <= 4
        assert np.abs(strikes[standing] - segment.start).min() <= 4
    for before, after in pairwise(found.segments):
        assert before.end == after.start
        assert before.label != after.label


def test_each_step_has_one_keyframe_where_the_feet_pass() -> None:
    clip = generate_gait(1.4, 0.0, 6.0)
    found = steps(clip)
    frames = [keyframe.frame for keyframe in found.keyframes]
    assert {keyframe.label for keyframe in found.keyframes} == {"passing"}
    for segment in found.segments:
        (frame,) = [frame for frame in frames if segment.start <= frame < segment.end]
        assert 0.2 < (frame - segment.start) / (segment.end - segment.start) < 0.8


def test_a_mirrored_walk_has_the_same_steps_of_the_other_feet() -> None:
    clip = generate_gait(1.4, radians(20), 6.0)
    body = body_of(clip)
    other = {"step_left": "step_right", "step_right": "step_left"}
    mirrored = propose_steps(mirror_clip(clip, body.partners), body)
    found = steps(clip)
    assert [segment._replace(label=other[segment.label]) for segment in found.segments] == list(mirrored.segments)
    assert found.keyframes == mirrored.keyframes


@pytest.mark.parametrize("frame_rate_hz", [30.0, 120.0])
def test_the_frame_rate_does_not_change_what_is_found(frame_rate_hz: float) -> None:
    at_60 = steps(generate_gait(1.4, 0.0, 6.0))
    other = steps(generate_gait(1.4, 0.0, 6.0, frame_rate_hz))
    assert abs(len(other.segments) - len(at_60.segments)) <= 1  # one may end just after the clip
    for a, b in zip(other.segments, at_60.segments, strict=False):
        assert a.label == b.label
        assert a.start / frame_rate_hz == pytest.approx(b.start / 60.0, abs=0.06)


def test_noise_makes_no_step_and_takes_none_away() -> None:
    clip = generate_gait(1.4, 0.0, 6.0, 120.0)
    generator = np.random.default_rng(4)
    noise = np.zeros_like(clip.poses)
    noise[:, :3] = generator.normal(scale=0.001, size=(clip.frame_count, 3))
    shaken = replace(clip, poses=clip.poses + noise)
    single = clip.poses.copy()
    single[200, :3] += 0.02
    for disturbed in (shaken, replace(clip, poses=single)):
        assert count(steps(disturbed)) == count(steps(clip))


def test_somebody_who_walks_off_and_stops_has_a_first_and_a_last_step() -> None:
    clip = generate_along(start_and_stop(1.35, wait_s=1.5, ramp_s=1.0, cruise_s=4.0))
    labels = [segment.label for segment in steps(clip).segments]
    assert labels[0] == labels[-1] == "standing"
    assert labels[1].startswith("start_")
    assert labels[-2].startswith("stop_")
    assert all(label.startswith("step_") for label in labels[2:-2])


def test_steps_of_a_run_are_told_from_those_of_a_walk() -> None:
    assert count(steps(generate_gait(3.4, 0.0, 5.0))).keys() == {"run_left", "run_right"}


@pytest.mark.parametrize(
    ("speed_m_s", "turn_deg_s", "travel_deg"),
    [(0.9, 0, 180), (0.6, 0, 90), (0.0, 60, 0)],
    ids=["backward", "aside", "turning on the spot"],
)
def test_what_leads_nowhere_ahead_has_no_steps(speed_m_s: float, turn_deg_s: int, travel_deg: int) -> None:
    clip = generate_gait(speed_m_s, radians(turn_deg_s), 5.0, travel_angle_rad=radians(travel_deg))
    assert count(steps(clip)).keys() <= {"standing"}


def test_standing_is_one_segment_and_steps_of_a_turn_can_be_left_out() -> None:
    idle = generate_gait(0.0, 0.0, 4.0)
    assert [segment.label for segment in steps(idle).segments] == ["standing"]
    curve = generate_gait(1.2, radians(50), 6.0)
    assert count(steps(curve))
    assert not count(steps(curve, most_turn_deg=10.0))


def test_a_clip_of_one_frame_has_nothing_to_propose() -> None:
    clip = generate_gait(1.4, 0.0, 1.0).sliced(0, 1)
    assert steps(clip).segments in ((), (("standing", 0, 1),))


def test_stances_do_not_depend_on_flicker_shorter_than_a_swing() -> None:
    clip = generate_gait(1.2, 0.0, 5.0, 120.0)
    left, right = find_stances(clip, body_of(clip), ContactOptions())
    for of_side in (left, right):
        assert all(after.start - before.end >= 0.1 * 120 for before, after in pairwise(of_side))


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"standing_s": -1.0}, "standing_s"),
        ({"most_turn_deg": float("nan")}, "most_turn_deg"),
        ({"longest_s": 0.1}, "longest_s"),
    ],
)
def test_options_that_make_no_sense_are_refused_by_name(options: dict[str, Any], where: str) -> None:
    with pytest.raises(ValidationError, match=where):
        StepsProposal(**options)
