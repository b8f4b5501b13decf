"""Planted feet, which keep their position on the ground."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import runs
from marey_motion.editing.foot_plants import (
    Foot,
    FootContacts,
    PlantedMotion,
    find_contacts,
    foot_slide_m,
    plant_feet,
)
from marey_motion.editing.inverse_kinematics.limbs import limb_ending_at
from marey_motion.errors import EditError
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import PlantOptions


def _feet(skeleton: Skeleton, clip: Clip | None = None) -> list[Foot]:
    mapping = map_joints(skeleton)
    axes = guess_axes(skeleton, mapping, clip)
    feet = []
    for side in ("left", "right"):
        ankle, toe = mapping.indices(skeleton, (f"{side}_ankle", f"{side}_toe"))
        leg = limb_ending_at(skeleton, mapping, ankle, axes)
        assert leg is not None
        feet.append(Foot(leg, toe))
    return feet


def _sliding(clip: Clip, size_m: float = 0.02) -> Motion:
    """Return the motion with a slow oscillation of the root; the feet slide, but so little that contacts are found."""
    motion = Motion.of(clip)
    t = np.arange(clip.frame_count) / clip.frame_rate_hz
    wobble = size_m * np.stack((np.sin(3.1 * t), 0.3 * np.sin(2.3 * t + 1.0), np.cos(2.7 * t)), axis=1)
    return motion._replace(root_translations=motion.root_translations + wobble)


def _longest_contact(clip: Clip, motion: Motion, foot: Foot) -> tuple[int, int]:
    touching = find_contacts(motion.positions(clip.skeleton), foot, clip.frame_rate_hz, PlantOptions())
    inside = [one for one in runs(touching.toe) if one[0] > 20 and one[1] < clip.frame_count - 20]
    return max(inside, key=lambda one: one[1] - one[0])


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.2, 0.1, 4.0)


@pytest.fixture(scope="module")
def planted(walk: Clip) -> tuple[Motion, PlantedMotion]:
    sliding = _sliding(walk)
    return sliding, plant_feet(walk.skeleton, sliding, walk.frame_rate_hz, _feet(walk.skeleton))


def test_sliding_feet_stand_still(walk: Clip, planted: tuple[Motion, PlantedMotion]) -> None:
    _, result = planted
    assert result.slide_before_m > 0.01
    assert result.slide_after_m < 0.02 * result.slide_before_m
    places = result.motion.positions(walk.skeleton)
    contacts = 0
    for foot, touching in zip(_feet(walk.skeleton), result.contacts, strict=True):
        for start, stop in runs(touching.toe):
            assert np.ptp(places[start:stop, foot.toe], axis=0).max() < 1e-3
            contacts += 1
        for start, stop in runs(touching.toe & touching.heel):
            assert np.ptp(places[start:stop, foot.leg.end], axis=0).max() < 1e-3
    assert contacts >= 8


def test_feet_do_not_jump_where_contacts_begin_and_end(walk: Clip, planted: tuple[Motion, PlantedMotion]) -> None:
    sliding, result = planted
    for foot in _feet(walk.skeleton):
        for joint in (foot.leg.end, foot.toe):
            before, after = (
                np.abs(np.diff(one.positions(walk.skeleton)[:, joint], 2, axis=0)) for one in (sliding, result.motion)
            )
            assert after.max() < 1.25 * before.max()
            assert after[:, 1].max() < 1.25 * before[:, 1].max()


def test_bodies_above_the_legs_stay_as_they_are(walk: Clip, planted: tuple[Motion, PlantedMotion]) -> None:
    sliding, result = planted
    legs = {joint for foot in _feet(walk.skeleton) for joint in foot.leg.joints}
    others = [joint for joint in range(walk.skeleton.joint_count) if joint not in legs]
    assert result.motion.rotations[:, others].tobytes() == sliding.rotations[:, others].tobytes()
    assert np.array_equal(result.motion.root_translations[:, (0, 2)], sliding.root_translations[:, (0, 2)])
    lowered = sliding.root_translations[:, 1] - result.motion.root_translations[:, 1]
    assert lowered.min() >= 0.0
    assert lowered.max() == pytest.approx(result.lowered_m)


def test_feet_that_stand_already_hardly_move(walk: Clip) -> None:
    motion = Motion.of(walk)
    result = plant_feet(walk.skeleton, motion, walk.frame_rate_hz, _feet(walk.skeleton))
    moved = np.linalg.norm(result.motion.positions(walk.skeleton) - motion.positions(walk.skeleton), axis=-1)
    assert moved.max() < 0.01
    assert result.slide_after_m <= result.slide_before_m + 1e-6


def test_a_foot_with_its_toe_alone_rolls_about_it(walk: Clip) -> None:
    sliding = _sliding(walk)
    feet = _feet(walk.skeleton)
    start, stop = _longest_contact(walk, sliding, feet[0])
    toe = np.zeros(walk.frame_count, dtype=np.bool_)
    toe[start:stop] = True
    nothing = np.zeros_like(toe)
    contacts = [FootContacts(toe, nothing), FootContacts(nothing, nothing)]
    result = plant_feet(walk.skeleton, sliding, walk.frame_rate_hz, feet, contacts=contacts)
    places = result.motion.positions(walk.skeleton)[start:stop]
    assert np.ptp(places[:, feet[0].toe], axis=0).max() < 1e-3
    assert np.ptp(places[:, feet[0].leg.end], axis=0).max() > 0.02
    spins = [
        kinematics.as_global_rotations(walk.skeleton, one.rotations)[100:130, feet[0].leg.end]
        for one in (sliding, result.motion)
    ]
    assert quaternions.angle_between(*spins).max() < 1e-6
    blend = round(PlantOptions().blend_s * walk.frame_rate_hz)
    outside = np.r_[0 : start - blend, stop + blend : walk.frame_count]
    assert result.motion.rotations[outside].tobytes() == sliding.rotations[outside].tobytes()


def test_the_root_comes_down_for_a_leg_that_is_too_short(walk: Clip) -> None:
    motion = Motion.of(walk)
    feet = _feet(walk.skeleton)
    # The body bobs up, so that the left foot comes off the place it should keep.
    drift = np.zeros((walk.frame_count, 3))
    start, stop = _longest_contact(walk, motion, feet[0])
    drift[start:stop, 1] = 0.05 * np.hanning(stop - start)
    risen = motion._replace(root_translations=motion.root_translations + drift)
    toe = np.zeros(walk.frame_count, dtype=np.bool_)
    toe[start:stop] = True
    contacts = [FootContacts(toe, ~toe & toe), FootContacts(~toe & toe, ~toe & toe)]
    result = plant_feet(walk.skeleton, risen, walk.frame_rate_hz, feet, contacts=contacts)
    assert 0.001 < result.lowered_m <= 0.1
    places = result.motion.positions(walk.skeleton)[start:stop, feet[0].toe]
    assert np.ptp(places, axis=0).max() < 1e-3
    reach = 3 * round(PlantOptions().blend_s * walk.frame_rate_hz)
    outside = np.r_[0 : max(0, start - reach), stop + reach : walk.frame_count]
    assert len(outside) > 0
    assert np.array_equal(result.motion.root_translations[outside], risen.root_translations[outside])
    assert np.array_equal(result.motion.rotations[outside], risen.rotations[outside])
    steps = np.diff(result.motion.root_translations[:, 1], 2)
    assert np.abs(steps).max() < np.abs(np.diff(risen.root_translations[:, 1], 2)).max() + 2e-3


def test_contacts_that_do_not_fit_the_motion_are_refused(walk: Clip) -> None:
    short = FootContacts(np.ones(3, np.bool_), np.ones(3, np.bool_))
    with pytest.raises(EditError, match="each of the motion's 240 frames"):
        plant_feet(walk.skeleton, Motion.of(walk), 60.0, _feet(walk.skeleton), contacts=[short, short])
    with pytest.raises(ValidationError, match="blend_s"):
        PlantOptions(blend_s=-1.0)


def test_clips_of_one_frame_and_without_contacts_stay_as_they_are(walk: Clip) -> None:
    running = Motion.of(walk)._replace(root_translations=np.linspace(0, 40, walk.frame_count)[:, None] * np.ones(3))
    nothing = plant_feet(walk.skeleton, running, walk.frame_rate_hz, _feet(walk.skeleton))
    assert nothing.slide_before_m == nothing.slide_after_m == 0.0
    assert nothing.motion.rotations.tobytes() == running.rotations.tobytes()
    one = Motion.of(walk).at_frames(np.array([7]))
    planted = plant_feet(walk.skeleton, one, walk.frame_rate_hz, _feet(walk.skeleton))
    np.testing.assert_allclose(planted.motion.positions(walk.skeleton), one.positions(walk.skeleton), atol=1e-6)


def test_the_same_motion_is_planted_in_the_same_bytes(walk: Clip, planted: tuple[Motion, PlantedMotion]) -> None:
    again = plant_feet(walk.skeleton, _sliding(walk), walk.frame_rate_hz, _feet(walk.skeleton))
    assert again.motion.rotations.tobytes() == planted[1].motion.rotations.tobytes()


@pytest.mark.parametrize(("frames", "expected"), [(2, [(0, 120)]), (20, [(0, 59), (80, 120)])])
def test_gaps_in_a_contact_that_are_shorter_than_any_contact_are_noise(
    walk: Clip, frames: int, expected: list[tuple[int, int]]
) -> None:
    foot = _feet(walk.skeleton)[0]
    positions = np.zeros((120, walk.skeleton.joint_count, 3))
    positions[60 : 60 + frames, (foot.toe, foot.leg.end)] = np.linspace(0.01, 0.01 * frames, frames)[:, None, None]
    positions[60 + frames :, (foot.toe, foot.leg.end)] = 0.01 * frames
    found = find_contacts(positions, foot, 60.0, PlantOptions())
    for flags in found:
        assert [(start, stop) for start, stop in runs(flags)] == expected


@pytest.mark.parametrize("gap", [8, 14])
def test_knees_do_not_pop_where_a_toe_flickers_under_a_standing_heel(gap: int) -> None:
    walk = generate_gait(1.2, 0.1, 4.0, frame_rate_hz=120.0)
    sliding, feet = _sliding(walk), _feet(walk.skeleton)
    start, stop = _longest_contact(walk, sliding, feet[0])
    toe = np.zeros(walk.frame_count, dtype=np.bool_)
    toe[start:stop] = True
    heel, nothing = toe.copy(), np.zeros_like(toe)
    middle = (start + stop) // 2
    toe[middle - gap : middle] = False
    contacts = [FootContacts(toe, heel), FootContacts(nothing, nothing)]
    result = plant_feet(walk.skeleton, sliding, walk.frame_rate_hz, feet, contacts=contacts)
    turns = [
        quaternions.angle_between(*(one.rotations[part, feet[0].leg.middle] for part in (slice(1, None), slice(-1))))
        for one in (sliding, result.motion)
    ]
    assert (turns[1] - turns[0]).max() < np.radians(6.0)


@pytest.mark.parametrize("at_the_end", [False, True])
def test_noise_in_a_contact_does_not_carry_the_foot_off_around_it(at_the_end: bool) -> None:
    walk = generate_gait(1.2, 0.1, 4.0, frame_rate_hz=120.0)
    noise = np.random.default_rng(3).normal(0.0, 0.002, (walk.frame_count, 3))
    motion, feet = Motion.of(walk), _feet(walk.skeleton)
    start, stop = _longest_contact(walk, motion, feet[0])
    motion = motion._replace(root_translations=motion.root_translations + noise)
    if at_the_end:
        motion = motion.at_frames(np.arange(stop + 12))
    toe = np.zeros(motion.frame_count, dtype=np.bool_)
    toe[start:stop] = True
    contacts = [FootContacts(toe, toe), FootContacts(~toe & toe, ~toe & toe)]
    result = plant_feet(walk.skeleton, motion, walk.frame_rate_hz, feet, contacts=contacts)
    places = [one.positions(walk.skeleton)[:, feet[0].toe] for one in (motion, result.motion)]
    moved = np.linalg.norm(places[1] - places[0], axis=1)
    assert moved[~toe].max() < 1.5 * moved[toe].max()


@pytest.mark.parametrize(
    "name", ["cmu-amc/07/07_01-walk.amc", "cmu-amc/02/02_01.amc", "bandai-namco-2/*walk*normal*001.bvh"]
)
def test_captured_feet_slide_by_less_than_a_tenth_of_a_millimetre(mocap: Path, name: str) -> None:
    path = sorted(mocap.glob(name))[0]
    companion = next(path.parent.glob("*.asf")).read_bytes() if path.suffix == ".amc" else None
    clip = read_motion(path.read_bytes(), path.name, companion=companion).clip
    assert clip is not None
    motion, feet = Motion.of(clip), _feet(clip.skeleton, clip)
    result = plant_feet(clip.skeleton, motion, clip.frame_rate_hz, feet)
    assert result.slide_before_m > 0.003
    assert result.slide_after_m < 1e-4
    assert result.lowered_m < 0.03
    for foot in feet:
        for joint in (foot.leg.end, foot.toe):
            jolts = [
                np.abs(np.diff(one.positions(clip.skeleton)[:, joint, 1], 2)).max() for one in (motion, result.motion)
            ]
            assert jolts[1] < 1.5 * jolts[0]
        found = find_contacts(motion.positions(clip.skeleton), foot, clip.frame_rate_hz, PlantOptions())
        before, after = (foot_slide_m(one.positions(clip.skeleton), foot, found) for one in (motion, result.motion))
        assert np.all(after <= before)
