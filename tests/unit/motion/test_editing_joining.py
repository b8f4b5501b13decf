"""Concatenation of clips."""

from dataclasses import replace
from math import degrees
from typing import Any

import numpy as np
import pytest
from tests.support.edited_takes import (
    largest_step,
    make_breathing_walk,
    make_walk,
    require_sound,
    same_poses,
    under_static_root,
)

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.borders import blended
from marey_motion.editing.registry import apply_edit
from marey_motion.errors import EditError
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.kinematics import global_positions
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs import map_joints
from marey_schemas.editing.commands import Concatenate, Rotate, Translate
from marey_schemas.editing.edits import AnyCommand

BLENDS = ("inertialise", "slerp")


def join(first: Clip, second: Clip, **given: Any) -> Clip:
    return apply_edit(first, [Concatenate(source="second", **given)], sources={"second": second})


def heading_of(clip: Clip) -> np.ndarray:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    positions = global_positions(clip)
    return kinematics.headings(kinematics.forward_directions(positions, body.lefts, body.rights))


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("away", [0.0, 2.5])
def test_the_second_goes_on_where_the_first_ends(blend: str, away: float) -> None:
    first = make_walk(turn_rate_rad_s=0.6)
    elsewhere: list[AnyCommand] = [Rotate(angle_deg=degrees(away)), Translate(shift_m=(5.0, 0.0, -3.0))]
    second = apply_edit(make_walk(turn_rate_rad_s=-0.4), elsewhere)
    joined = join(first, second, blend=blend)
    require_sound(joined)
    assert np.array_equal(joined.poses[: first.frame_count - 20], first.poses[: first.frame_count - 20])
    assert largest_step(joined) < 2.0 * max(largest_step(first), largest_step(second))
    assert np.abs(np.diff(heading_of(joined))).max() < 0.03


def test_inertialising_keeps_all_frames_and_a_fade_overlaps_them() -> None:
    first, second = make_walk(seconds=2.0), make_walk(seconds=1.5)
    frames = first.frame_count + second.frame_count
    assert join(first, second, blend="inertialise", blend_s=0.3).frame_count == frames
    assert join(first, second, blend="slerp", blend_s=0.3).frame_count == frames - 18
    assert join(first, second, blend="slerp", blend_s=0.0).frame_count == frames


def test_pose_and_velocity_are_continuous_at_an_inertialised_seam() -> None:
    first, second = make_breathing_walk(seconds=2.3), make_breathing_walk(seconds=2.0, speed_m_s=0.8)
    joined = join(first, second, blend_s=0.5)
    seam = first.frame_count
    places = global_positions(joined).astype(np.float64)
    steps = np.diff(places, axis=0)
    jumps = np.linalg.norm(np.diff(steps, axis=0), axis=-1).max(axis=1)
    hard = np.diff(np.diff(global_positions(join(first, second, blend_s=0.0)).astype(np.float64), axis=0), axis=0)
    assert jumps[seam - 3 : seam + 2].max() < 0.3 * np.linalg.norm(hard, axis=-1)[seam - 3 : seam + 2].max()
    # What dies away is gone at the end of the blend: from then on the second plays on, moved on the ground alone.
    rest = slice(seam + 30, None)
    assert np.allclose(joined.rotations[rest, 1:], second.rotations[30:, 1:], atol=1e-5) or same_joints(
        joined, second, seam, 30
    )


def same_joints(joined: Clip, second: Clip, seam: int, after: int) -> bool:
    dots = np.abs(np.sum(joined.rotations[seam + after :, 1:] * second.rotations[after:, 1:], axis=-1))
    return bool(np.all(dots > 1.0 - 1e-5))


def test_a_clip_of_another_rate_is_brought_to_this_one() -> None:
    first, second = make_walk(rate_hz=60.0), make_walk(rate_hz=120.0)
    joined = join(first, second)
    assert joined.frame_rate_hz == 60.0
    assert joined.frame_count == first.frame_count + (second.frame_count - 1) // 2 + 1


def test_translations_that_only_one_of_them_has_become_offsets_in_the_other() -> None:
    still, breathing = make_walk(), make_breathing_walk()
    for first, second in ((still, breathing), (breathing, still)):
        joined = join(first, second, blend_s=0.0)
        assert joined.translated_joints == breathing.translated_joints
        assert joined.translations is not None
        own = joined.translations[: still.frame_count] if first is still else joined.translations[-still.frame_count :]
        assert np.allclose(own, still.skeleton.offsets[list(joined.translated_joints)], atol=1e-6)


def test_a_pose_can_be_appended_to_a_pose() -> None:
    pose = make_walk().sliced(0, 1)
    joined = join(pose, make_walk().sliced(30, 31), blend_s=0.0)
    assert joined.frame_count == 2
    require_sound(joined)


def test_clips_of_other_skeletons_are_refused() -> None:
    stranger = game_skeleton()
    pose = np.concatenate((stranger.offsets[0], stranger.rest_rotations.ravel())).astype(np.float32)
    with pytest.raises(EditError, match="has a different skeleton from the edited clip; retarget it first"):
        join(make_walk(), Clip(stranger, 60.0, pose[None]))


def test_unknown_sources_are_told_with_those_that_there_are() -> None:
    with pytest.raises(EditError, match=r"no source clip is called 'third'; the source clips are: second"):
        apply_edit(make_walk(), [Concatenate(source="third")], sources={"second": make_walk()})


def test_joining_stops_before_memory_does() -> None:
    walk = make_walk()
    again = [Concatenate(source="walk")] * 40
    with pytest.raises(EditError, match="the edited clip would have") as refused:
        apply_edit(walk, again, sources={"walk": walk}, most_numbers=20 * walk.poses.size)
    assert refused.value.code == "edit-too-large"


def test_a_walk_joined_to_itself_at_the_same_phase_walks_on() -> None:
    whole = generate_gait(1.3, 0.0, 4.0)
    first, second = whole.sliced(0, 100), whole.sliced(100, 240)
    assert np.abs(global_positions(join(first, second)) - global_positions(whole)).max() < 0.02
    assert np.abs(global_positions(join(first, second, blend_s=0.0)) - global_positions(whole)).max() < 1e-3
    assert same_poses(join(first, second, place="keep", blend_s=0.0), whole, 1e-6)
    overlapping = join(first, whole.sliced(82, 240), blend="slerp", blend_s=0.3)
    assert np.abs(global_positions(overlapping) - global_positions(whole)).max() < 1e-3


def lowest_foot(clip: Clip) -> float:
    joints = map_joints(clip.skeleton).joints
    feet = [clip.skeleton.index_of(joints[f"{side}_{part}"]) for side in ("left", "right") for part in ("ankle", "toe")]
    return float(global_positions(clip)[:, feet, 1].min())


def turning_and_jolting(clip: Clip) -> np.ndarray:
    """Return the largest turn of the body between frames (rad), and the largest change of the root's steps (m)."""
    jolts = np.diff(clip.root_translations.astype(np.float64), 2, axis=0)
    return np.array((np.abs(np.diff(np.unwrap(heading_of(clip)))).max(), np.linalg.norm(jolts, axis=-1).max()))


@pytest.mark.parametrize(
    ("blend", "start"), [("inertialise", 100), ("inertialise", 97), ("inertialise", 82), ("slerp", 82)]
)
def test_feet_and_heading_go_on_at_the_seam(blend: str, start: int) -> None:
    """A curved walk follows a straight walk. A fade overlaps 18 frames; without overlap, the clips are out of step."""
    first = generate_gait(1.3, 0.0, 4.0).sliced(0, 100)
    second = generate_gait(1.3, 0.3, 4.0).sliced(start, 240)
    joined = join(first, second, blend=blend)
    assert lowest_foot(joined) > 0.015
    own = np.maximum(turning_and_jolting(first), turning_and_jolting(second))
    assert (turning_and_jolting(joined) <= 1.25 * own).all()


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("turned_by", [0.0, 1.5, 3.1])
def test_bodies_under_a_static_root_are_joined_as_bodies_that_are_the_root(blend: str, turned_by: float) -> None:
    first = make_walk(turn_rate_rad_s=0.6)
    elsewhere: list[AnyCommand] = [Rotate(angle_deg=degrees(turned_by)), Translate(shift_m=(5.0, 0.0, -3.0))]
    second = apply_edit(make_walk(turn_rate_rad_s=-0.4), elsewhere)
    joined = join(under_static_root(first), under_static_root(second), blend=blend)
    require_sound(joined)
    assert np.abs(global_positions(joined)[:, 1:] - global_positions(join(first, second, blend=blend))).max() < 1e-4
    assert np.abs(joined.rotations[:, 0] - (1.0, 0.0, 0.0, 0.0)).max() < 1e-5


def with_turning_root(clip: Clip, rate_rad_s: float) -> Clip:
    """Return the clip with a root that turns, and hips that undo this turn, so that the body moves as before."""
    under = under_static_root(clip)
    turns = quaternions.from_axis_angle((0.0, 1.0, 0.0), rate_rad_s / clip.frame_rate_hz * np.arange(clip.frame_count))
    back = quaternions.conjugate(turns)
    poses = under.poses.copy()
    poses[:, 3:7], poses[:, 7:11] = turns, quaternions.multiply(back, under.rotations[:, 1])
    assert under.translations is not None
    places = quaternions.rotate_vectors(back, under.translations[:, 0])[:, None].astype(np.float32)
    return replace(under, poses=poses, translations=places)


@pytest.mark.parametrize("blend", BLENDS)
def test_bodies_under_roots_that_turn_are_joined_as_bodies_that_are_the_root(blend: str) -> None:
    first, second = make_walk(turn_rate_rad_s=0.6), make_walk(turn_rate_rad_s=-0.4)
    joined = join(with_turning_root(first, 0.9), with_turning_root(second, 0.3), blend=blend)
    require_sound(joined)
    assert np.abs(global_positions(joined)[:, 1:] - global_positions(join(first, second, blend=blend))).max() < 1e-4


def test_rotations_half_a_turn_apart_are_blended_on_one_side() -> None:
    """Over the blend, the two rotations of a joint pass half a turn of difference, where the shorter way changes."""
    count = 21
    angles = np.linspace(0.9, 1.1, count) * np.pi
    a = np.zeros((count, 2, 4))
    a[..., 0] = 1.0
    b = np.stack((np.cos(0.5 * angles), np.zeros(count), np.sin(0.5 * angles), np.zeros(count)), axis=1)[:, None]
    b = np.concatenate((b, a[:, :1]), axis=1)
    made = blended(a, b, np.linspace(0.0, 1.0, count + 2)[1:-1])
    turns = np.degrees(quaternions.angle_between(made[1:], made[:-1]))
    assert turns.max() < 15.0
    assert np.array_equal(made[:, 1], a[:, 1])
