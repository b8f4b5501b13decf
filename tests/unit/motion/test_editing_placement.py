"""Motions moved as a whole."""

from math import degrees, pi, radians
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.edited_takes import make_breathing_walk, make_walk, same_poses
from tests.support.present import present

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.registry import apply_edit
from marey_motion.errors import EditError, MotionError
from marey_motion.kinematics import global_positions
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs import map_joints
from marey_schemas.editing.commands import Face, FixDrift, FlipAxes, MoveToOrigin, Rotate, Scale, SignedAxis, Translate


def headings_of(clip: Clip) -> np.ndarray:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    directions = kinematics.forward_directions(global_positions(clip), body.lefts, body.rights)
    return kinematics.headings(directions)


def test_turning_and_turning_back_gives_the_motion() -> None:
    walk = make_breathing_walk(turn_rate_rad_s=0.5)
    there = Rotate(angle_deg=degrees(1.1), axis=(1.0, 2.0, -0.5), pivot="origin")
    back = Rotate(angle_deg=degrees(-1.1), axis=(1.0, 2.0, -0.5), pivot="origin")
    assert same_poses(apply_edit(walk, [there, back]), walk)
    assert not same_poses(apply_edit(walk, [there]), walk)


def test_a_turn_about_the_vertical_is_to_the_left_and_keeps_heights() -> None:
    walk = make_walk()
    turned = apply_edit(walk, [Rotate(angle_deg=degrees(0.5 * pi))])
    before, after = global_positions(walk), global_positions(turned)
    assert np.allclose(after[..., 1], before[..., 1], atol=1e-5)
    assert np.allclose(after[..., 0], before[..., 2], atol=1e-5)  # what went along +z goes along +x
    assert headings_of(turned)[0] == pytest.approx(headings_of(walk)[0] + 0.5 * pi, abs=1e-5)


def test_a_turn_about_the_body_leaves_the_first_frame_where_it_is() -> None:
    walk = apply_edit(make_walk(), [Translate(shift_m=(3.0, 0.0, -2.0))])
    turned = apply_edit(walk, [Rotate(angle_deg=degrees(2.0), pivot="body")])
    assert np.allclose(turned.root_translations[0], walk.root_translations[0], atol=1e-5)
    assert not np.allclose(turned.root_translations[-1], walk.root_translations[-1], atol=0.1)


def test_shifting_moves_every_joint_alike() -> None:
    walk = make_breathing_walk()
    shifted = apply_edit(walk, [Translate(shift_m=(1.0, 0.5, -2.0))])
    assert np.allclose(global_positions(shifted) - global_positions(walk), [1.0, 0.5, -2.0], atol=1e-5)


@pytest.mark.parametrize(("heading_deg", "frame"), [(0.0, 0), (90.0, 0), (-135.0, 50), (720.0, 100)])
def test_facing_turns_the_body_where_it_stands(heading_deg: float, frame: int) -> None:
    walk = apply_edit(make_walk(turn_rate_rad_s=0.8), [Translate(shift_m=(2.0, 0.0, 1.0))])
    faced = apply_edit(walk, [Face(heading_deg=heading_deg, frame=frame)])
    wished = np.array([np.sin(radians(heading_deg)), np.cos(radians(heading_deg))])
    heading = headings_of(faced)[frame]
    assert np.allclose([np.sin(heading), np.cos(heading)], wished, atol=1e-5)
    hips = walk.skeleton.index_of("Hips")
    assert np.allclose(global_positions(faced)[frame, hips], global_positions(walk)[frame, hips], atol=1e-5)


def test_a_body_that_faces_nowhere_cannot_be_faced() -> None:
    skeleton = make_walk().skeleton
    rotations = skeleton.rest_rotations.copy()
    rotations[0] = quaternions.from_axis_angle([0.0, 0.0, 1.0], 0.5 * pi)  # on its side: the hips above one another
    pose = np.concatenate(([0.0, 0.2, 0.0], rotations.ravel())).astype(np.float32)
    with pytest.raises(MotionError, match="above, below or at the right joints") as refused:
        apply_edit(Clip(skeleton, 60.0, pose[None]), [Face()])
    assert (refused.value.code, refused.value.where) == ("heading-undefined", "commands[0] (face)")


def test_moving_to_the_origin_keeps_the_height_of_the_body() -> None:
    walk = apply_edit(make_walk(), [Translate(shift_m=(3.0, 0.25, -2.0))])
    moved = apply_edit(walk, [MoveToOrigin(frame=30)])
    hips = walk.skeleton.index_of("Hips")
    x, y, z = global_positions(moved)[30, hips]
    assert (x, z) == (pytest.approx(0.0, abs=1e-5), pytest.approx(0.0, abs=1e-5))
    assert y == pytest.approx(global_positions(walk)[30, hips, 1], abs=1e-5)


def test_scaling_scales_the_path_and_leaves_the_limbs() -> None:
    walk = make_breathing_walk()
    scaled = apply_edit(walk, [Scale(factor=0.5)])
    assert np.allclose(scaled.root_translations, 0.5 * walk.root_translations, atol=1e-6)
    assert np.array_equal(scaled.rotations, walk.rotations)
    assert np.array_equal(present(scaled.translations), present(walk.translations))
    whole = apply_edit(walk, [Scale(factor=0.5, translations=True)])
    assert np.allclose(present(whole.translations), 0.5 * present(walk.translations), atol=1e-6)


def test_a_world_with_z_up_gets_y_up() -> None:
    walk = make_walk()
    blender = apply_edit(walk, [Rotate(angle_deg=degrees(0.5 * pi), axis=(1.0, 0.0, 0.0))])  # y to z, z to -y
    assert global_positions(blender)[..., 2].min() == pytest.approx(0.0, abs=0.02)
    assert same_poses(apply_edit(blender, [FlipAxes(up="+z", forward="-y")]), walk)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
@pytest.mark.parametrize("forward", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_flipped_axes_are_a_rotation_that_takes_up_to_y_and_forward_to_z(up: SignedAxis, forward: SignedAxis) -> None:
    walk = make_walk(seconds=0.5)
    if up[1] == forward[1]:
        with pytest.raises(ValidationError, match="directions of the same axis"):
            FlipAxes(up=up, forward=forward)
        return
    flipped = apply_edit(walk, [FlipAxes(up=up, forward=forward)])
    before, after = global_positions(walk), global_positions(flipped)

    def along(axis: str) -> np.ndarray:
        return (-1.0 if axis[0] == "-" else 1.0) * before[..., "xyz".index(axis[1])]

    assert np.allclose(after[..., 1], along(up), atol=1e-5)
    assert np.allclose(after[..., 2], along(forward), atol=1e-5)
    length, unflipped = (np.linalg.norm(p[:, 1:] - p[:, :1], axis=-1) for p in (after, before))
    assert np.allclose(length, unflipped, atol=1e-5)


@pytest.mark.parametrize("profile", ["linear", "smooth"])
def test_drift_is_taken_out_little_by_little(profile: Literal["linear", "smooth"]) -> None:
    walk = make_walk(seconds=4.0)
    given: dict[str, Any] = {
        "shift_m": (0.4, 0.0, -0.2),
        "turn_deg": degrees(0.3),
        "frames": (60, 180),
        "profile": profile,
    }
    fixed = apply_edit(walk, [FixDrift(**given)])
    hips = walk.skeleton.index_of("Hips")
    before, after = global_positions(walk)[:, hips], global_positions(fixed)[:, hips]
    assert np.allclose(after[:61], before[:61], atol=1e-5)
    assert np.allclose(after[179] - before[179], [0.4, 0.0, -0.2], atol=1e-5)
    turned = headings_of(fixed) - headings_of(walk)
    assert np.allclose(turned[:61], 0.0, atol=1e-5)
    assert np.allclose(turned[179:], 0.3, atol=1e-5)
    assert np.all(np.diff(turned) > -1e-5)
    place = 30 / 119
    share = place if profile == "linear" else place**2 * (3.0 - 2.0 * place)
    assert np.isclose(turned[90], 0.3 * share, atol=1e-5)
    # What follows moves rigidly with the end of the range.
    assert np.allclose(
        np.linalg.norm(after[180:] - after[179], axis=-1),
        np.linalg.norm(before[180:] - before[179], axis=-1),
        atol=1e-5,
    )


@pytest.mark.parametrize(("frames", "seconds"), [((100, 101), 4.0), (None, 1 / 60)])
def test_drift_of_a_single_frame_is_refused(frames: tuple[int, int] | None, seconds: float) -> None:
    walk = make_walk(seconds=4.0).sliced(0, round(60 * seconds))
    with pytest.raises(EditError, match="only one frame; the drift must be spread over at least 2"):
        apply_edit(walk, [FixDrift(shift_m=(1.0, 0.0, 0.0), frames=frames)])
