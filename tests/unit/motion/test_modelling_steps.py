"""Sequences of motions: their continuity and their constraints, in the world and in real time."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.search_primitives import sliding, standard_joints, walking

from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions, headings
from marey_motion.modelling.search.constraints import InvalidConstraint
from marey_motion.modelling.search.finishing import finish_motion
from marey_motion.modelling.search.found_motions import FoundMotion, found_motion
from marey_motion.modelling.search.step_search import Sequel, search_steps
from marey_motion.modelling.search.steps import MOST_SEARCH_STEPS, Step
from marey_motion.modelling.search.tree import SampleTree, build_tree
from marey_motion.quaternions import from_axis_angle
from marey_motion.rigs import map_joints
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.options.searching import RefineOptions, TransitionOptions
from marey_schemas.search_constraints import (
    JointOrientationConstraint,
    JointPositionConstraint,
    LookDirectionConstraint,
    RootHeadingConstraint,
    RootPositionConstraint,
)

START = Placement(0.5, 1.0, -2.0)


@functools.cache
def tree() -> SampleTree:
    return build_tree(walking()[0], 1, TreeOptions(samples=2000, features="latent"))


def walk_to(*places: Any) -> list[Step]:
    """Return one step of a walk for each place, constrained to end there on the ground."""
    return [
        Step(walking()[0], (RootPositionConstraint(at="end", target_m=place, tolerance_m=0.05),), standard_joints())
        for place in places
    ]


@functools.cache
def three_steps() -> list[Step]:
    """Return three steps of a walk, which are only made if a test uses them: each test process imports this module."""
    return walk_to((1.6, -0.9), (2.3, 0.2), (3.1, 1.2))


def found_three(**options: Any) -> tuple[Sequel, FoundMotion]:
    sequel = search_steps(three_steps(), [tree()] * 3, start=START, **options)
    return sequel, found_motion(three_steps(), sequel)


def heading_at(positions: Floats) -> Floats:
    joints = standard_joints()
    lefts, rights = ([joints[f"{side}_{part}"] for part in ("hip", "shoulder")] for side in ("left", "right"))
    return headings(forward_directions(positions, lefts, rights))


def test_a_step_may_begin_beyond_the_range_that_positions_in_requests_are_limited_to() -> None:
    steps = walk_to((None, 1e6), (None, 1e6))
    sequel = search_steps(steps, [tree()] * 2, start=Placement(0.0, 0.0, 1e6), refining=None)
    assert sequel.measured.placements[1].z > 1e6
    assert sequel.measured.jumps_m[0].max() < 1.0


@pytest.mark.parametrize("refining", [None, RefineOptions()])
def test_the_body_goes_on_where_and_as_it_stood(refining: RefineOptions | None) -> None:
    sequel, found = found_three(refining=refining)
    ends = [found.frame_of(step, walking()[0], "end") for step in range(3)]
    for number, (step, latent) in enumerate(zip(three_steps(), sequel.latents, strict=True)):
        if not number:
            continue
        # The first pose of a step, which stands in for the last one of the step before.
        motion = step.primitive.motions(latent[None])[0]
        positions = motion.positions(found.skeleton)[:1]
        placement = sequel.measured.placements[number]
        before = found.motion.positions(found.skeleton)[[ends[number - 1]]]
        turned = rotated(positions, placement)
        pelvis = standard_joints()["pelvis"]
        np.testing.assert_allclose(turned[0, pelvis, [0, 2]], before[0, pelvis, [0, 2]], atol=1e-9)
        np.testing.assert_allclose(heading_at(turned), heading_at(before), atol=1e-9)


def rotated(positions: Floats, placement: Placement) -> Floats:
    cos, sin = np.cos(placement.heading_rad), np.sin(placement.heading_rad)
    x, y, z = np.moveaxis(positions, -1, 0)
    return np.stack((cos * x + sin * z + placement.x, y, cos * z - sin * x + placement.z), axis=-1)


def test_refining_brings_hands_and_feet_together_at_the_seams() -> None:
    sampled, _ = found_three(refining=None)
    refined, _ = found_three(refining=RefineOptions(likelihood_weight=0.1))
    for before, after in zip(sampled.measured.jumps_m, refined.measured.jumps_m, strict=True):
        assert after.sum() < 0.7 * before.sum()
    assert max(jumps[1:].max() for jumps in refined.measured.jumps_m) < 0.12


def test_both_hands_and_both_feet_go_on_within_centimetres_of_where_they_were() -> None:
    sequel, _ = found_three(refining=RefineOptions(likelihood_weight=0.01))
    assert set(sequel.joints) == {"left_wrist", "right_wrist", "left_ankle", "right_ankle"}
    for jumps in sequel.measured.jumps_m:
        assert jumps.shape == (5,)
        assert jumps[1:].max() < 0.05


def test_steps_end_where_they_were_asked_to() -> None:
    sequel, found = found_three(transitions=TransitionOptions(tolerance_m=0.3))
    positions = found.motion.positions(found.skeleton)[:, standard_joints()["pelvis"]]
    for number, step in enumerate(three_steps()):
        root = step.constraints[0]
        assert isinstance(root, RootPositionConstraint)
        place = positions[found.frame_of(number, step.primitive, "end"), [0, 2]]
        reached = np.linalg.norm(place - np.array(root.target_m, dtype=np.float64))
        np.testing.assert_allclose(reached, sequel.measured.errors[number][0], atol=5e-3)
        assert reached < 0.1


def test_the_motion_begins_where_it_was_put() -> None:
    _, found = found_three()
    positions = found.motion.positions(found.skeleton)[:1]
    np.testing.assert_allclose(positions[0, standard_joints()["pelvis"], [0, 2]], (START.x, START.z), atol=0.05)
    np.testing.assert_allclose(heading_at(positions), START.heading_rad, atol=0.3)


def test_a_row_of_motions_has_the_frames_of_all_of_them_and_the_seams_once() -> None:
    sequel, found = found_three()
    lasting = [float(walking()[0].durations_s(one[None])[0]) * found.frame_rate_hz for one in sequel.latents]
    assert found.motion.frame_count == sum(map(round, lasting)) + 1
    assert found.starts == (0, round(lasting[0]), round(lasting[0]) + round(lasting[1]))
    jumps = np.einsum("fjc,fjc->fj", found.motion.rotations[1:], found.motion.rotations[:-1])
    assert jumps.min() > 0.0


def test_a_tolerance_that_is_larger_lets_joints_jump_more() -> None:
    tight, loose = (
        search_steps(three_steps(), [tree()] * 3, start=START, transitions=TransitionOptions(tolerance_m=size))
        for size in (0.005, 0.5)
    )
    assert sum(map(np.sum, tight.measured.jumps_m)) < sum(map(np.sum, loose.measured.jumps_m))


def test_one_step_needs_no_hips_and_shoulders() -> None:
    primitive = sliding(2)
    step = Step(primitive, (RootPositionConstraint(at="end", target_m=(0.3, None)),), {})
    one = build_tree(primitive, 0, TreeOptions(samples=500, features="latent"))
    sequel = search_steps([step], [one], start=Placement(0.0, 0.1, 0.0), refining=RefineOptions(likelihood_weight=1e-4))
    assert sequel.measured.errors[0][0] < 1e-3
    with pytest.raises(MotionError, match="left_hip"):
        search_steps([step, step], [one, one])


def test_a_constraint_that_is_wrong_is_told_by_step_and_place() -> None:
    steps = [
        three_steps()[0],
        Step(
            walking()[0],
            (RootHeadingConstraint(at="end", heading_deg=0.0), RootHeadingConstraint(at="never", heading_deg=0.0)),
            standard_joints(),
        ),
    ]
    with pytest.raises(InvalidConstraint, match="no keyframe 'never'") as caught:
        search_steps(steps, [tree()] * 2)
    assert caught.value.where == "steps[1].constraints[1].at"


@pytest.mark.parametrize("count", [0, MOST_SEARCH_STEPS + 1])
def test_the_number_of_steps_is_limited(count: int) -> None:
    with pytest.raises(InvalidConstraint, match="steps"):
        search_steps(three_steps()[:1] * count, [tree()] * count)


def test_steps_of_different_skeletons_make_no_motion() -> None:
    sequel = search_steps(three_steps()[:1], [tree()])
    primitive = sliding(2)
    other = Step(primitive, (), {})
    wrong = search_steps([other], [build_tree(primitive, 0, TreeOptions(samples=10, features="latent"))])
    with pytest.raises(InvalidConstraint, match="another skeleton") as caught:
        found_motion([three_steps()[0], other], joined(sequel, wrong))
    assert caught.value.where == "steps[1]"


def joined(first: Sequel, second: Sequel) -> Sequel:
    measured = first.measured._replace(placements=first.measured.placements + second.measured.placements)
    return replace(first, latents=first.latents + second.latents, measured=measured)


def test_inverse_kinematics_removes_what_is_left() -> None:
    wanted = (
        JointPositionConstraint(joint="left_wrist", at="middle", target_m=(1.6, 1.1, -1.3)),
        JointOrientationConstraint(joint="head", at="end", rotation=(1.0, 0.0, 0.3, 0.0)),
        LookDirectionConstraint(joint="head", at=4.0, direction=(0.3, 0.0, 1.0)),
        RootHeadingConstraint(at="end", heading_deg=30.0),
    )
    step = Step(walking()[0], wanted, standard_joints())
    sequel = search_steps([step], [tree()], start=START)
    found = found_motion([step], sequel)
    assert sequel.measured.errors[0][0] > 0.01
    finished = finish_motion([step], found, map_joints(found.skeleton))
    assert set(finished.errors) == {(0, 0), (0, 1), (0, 2)}
    assert max(finished.errors.values()) < 2e-3
    wrist = finished.found.motion.positions(found.skeleton)[found.frame_of(0, step.primitive, "middle")]
    np.testing.assert_allclose(
        wrist[standard_joints()["left_wrist"]], np.array(wanted[0].target_m, dtype=np.float64), atol=1e-3
    )
    pelvis = standard_joints()["pelvis"]
    before, after = (one.motion.positions(found.skeleton)[:, pelvis] for one in (found, finished.found))
    np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.parametrize("side", ["left", "right"])
def test_straight_legs_are_finished_with_knees_that_bend_forwards(side: str) -> None:
    step = three_steps()[0]
    found = found_motion([step], search_steps([step], [tree()], start=START))
    hip, knee, ankle = (standard_joints()[f"{side}_{part}"] for part in ("hip", "knee", "ankle"))
    rotations = found.motion.rotations.copy()
    rotations[:, knee] = from_axis_angle((1.0, 0.0, 0.0), np.radians(-0.1))
    found = replace(found, motion=found.motion._replace(rotations=rotations))
    frame = found.frame_of(0, step.primitive, "middle")
    before = found.motion.positions(found.skeleton)[frame]
    up = 0.03 * (before[hip] - before[ankle])
    raised = replace(
        step,
        constraints=(JointPositionConstraint(joint=f"{side}_ankle", at="middle", target_m=tuple(before[ankle] + up)),),
    )
    finished = finish_motion([raised], found, map_joints(found.skeleton)).found.motion
    after = finished.positions(found.skeleton)[frame]
    facing = forward_directions(
        before[None], (hip,), (standard_joints()["left_hip" if side == "right" else "right_hip"],)
    )
    forwards = np.array((facing[0, 0], 0.0, facing[0, 1])) * (1.0 if side == "left" else -1.0)
    assert (after[knee] - 0.5 * (after[hip] + after[ankle])) @ forwards > 0.05


def test_where_nothing_can_be_finished_the_motion_stays() -> None:
    step = three_steps()[0]
    found = found_motion([step], search_steps([step], [tree()], start=START))
    assert finish_motion([step], found, map_joints(found.skeleton)).found is found
