from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import game_skeleton, generate_gait, studio_skeleton
from marey_motion.kinematics import global_positions
from marey_motion.mirroring import mirror_clip
from marey_motion.rigs import map_joints, symmetric_joints
from marey_motion.skeleton import EndSite, Skeleton

REFLECTED = np.array([-1.0, 1.0, 1.0])


def partners_of(skeleton: Skeleton) -> NDArray[np.int32]:
    return symmetric_joints(skeleton, map_joints(skeleton))


def wild(skeleton: Skeleton, seed: int, *, translated: tuple[int, ...] = ()) -> Clip:
    """Return a clip of 20 frames of random rotations and root positions; joints in `translated` also move."""
    rng = np.random.default_rng(seed)
    rotations = rng.standard_normal((20, skeleton.joint_count, 4))
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    poses = np.concatenate((rng.standard_normal((20, 3)), rotations.reshape(20, -1)), axis=1).astype(np.float32)
    moved = rng.standard_normal((20, len(translated), 3)).astype(np.float32) if translated else None
    return Clip(skeleton, 60.0, poses, moved, translated)


def same_motion(a: Clip, b: Clip) -> bool:
    turned = quaternions.angle_between(a.rotations.astype(np.float64), b.rotations.astype(np.float64))
    return bool(turned.max() < 1e-5) and np.allclose(global_positions(a), global_positions(b), atol=1e-5)


def floats(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)


def with_rest_pose(skeleton: Skeleton, turns: NDArray[np.float64]) -> Skeleton:
    """Return the skeleton with other local axes: the frame of each joint is rotated by `turns` (J, 4)."""
    parents = np.concatenate(([[1.0, 0.0, 0.0, 0.0]], turns[skeleton.parents[1:]]))
    offsets = quaternions.rotate_vectors(quaternions.conjugate(parents), skeleton.offsets)
    rest = quaternions.multiply(quaternions.multiply(quaternions.conjugate(parents), skeleton.rest_rotations), turns)
    sites = tuple(
        EndSite(s.joint, floats(quaternions.rotate_vectors(quaternions.conjugate(turns[s.joint]), s.offset)))
        for s in skeleton.end_sites
    )
    return replace(skeleton, offsets=floats(offsets), rest_rotations=floats(rest), end_sites=sites)


def random_turns(count: int, seed: int) -> NDArray[np.float64]:
    turns = np.random.default_rng(seed).standard_normal((count, 4))
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def own_axes() -> Skeleton:
    """Return the studio skeleton with random local axes, which are different on the left and the right side."""
    plain = studio_skeleton()
    return with_rest_pose(plain, random_turns(plain.joint_count, 3))


def raised_arm() -> Skeleton:
    """Return the studio skeleton whose left arm points up and whose right leg points sideways at rest.

    The local axes are parallel to those of the world.
    """
    plain = studio_skeleton()
    offsets = plain.offsets.copy()
    quarter = quaternions.from_axis_angle((0.0, 0.0, 1.0), 0.5 * np.pi)
    tops = {plain.index_of(top) for top in ("LeftArm", "RightUpLeg")}
    for joint in range(plain.joint_count):
        if joint not in tops and tops & set(plain.path_to_root(joint)):
            offsets[joint] = quaternions.rotate_vectors(quarter, offsets[joint])
    sites = tuple(
        EndSite(s.joint, floats(quaternions.rotate_vectors(quarter, s.offset)))
        if tops & set(plain.path_to_root(s.joint))
        else s
        for s in plain.end_sites
    )
    return replace(plain, offsets=offsets, end_sites=sites)


@pytest.mark.parametrize("make", [studio_skeleton, own_axes, raised_arm], ids=["plain", "own axes", "asymmetric rest"])
def test_all_joints_are_where_the_mirror_shows_their_partners(make: Callable[..., Any]) -> None:
    skeleton = make()
    clip, partners = wild(skeleton, 1), partners_of(studio_skeleton())
    mirrored = global_positions(mirror_clip(clip, partners))
    np.testing.assert_allclose(mirrored, global_positions(clip)[:, partners] * REFLECTED, atol=2e-6)


def test_joints_whose_names_tell_no_side_are_found_by_what_they_carry() -> None:
    """Between root and thighs, the skeleton has hip joints, as in files with the names lhipjoint and rhipjoint."""
    plain = studio_skeleton()
    names = [{"LeftShoulder": "lyoke", "RightShoulder": "ryoke"}.get(name, name) for name in plain.joint_names]
    skeleton = replace(plain, joint_names=tuple(names), display_names=())
    left, right = names.index("lyoke"), names.index("ryoke")
    mapping = map_joints(plain)
    known = {standard: name for standard, name in mapping.joints.items() if name in names}
    partners = symmetric_joints(skeleton, replace(mapping, joints=known))
    assert (partners[left], partners[right]) == (right, left)
    assert np.array_equal(np.delete(partners, [left, right]), np.delete(partners_of(plain), [left, right]))


@pytest.mark.parametrize("make", [studio_skeleton, own_axes, raised_arm], ids=["plain", "own axes", "asymmetric rest"])
def test_mirroring_twice_is_the_motion_itself(make: Callable[..., Any]) -> None:
    clip, partners = wild(make(), 2), partners_of(studio_skeleton())
    assert same_motion(mirror_clip(mirror_clip(clip, partners), partners), clip)


def test_joints_without_a_counterpart_go_with_their_parent() -> None:
    skeleton = game_skeleton()
    partners = partners_of(skeleton)
    weapon, hand = skeleton.index_of("weapon_r"), skeleton.index_of("hand_r")
    clip = wild(skeleton, 4)
    mirrored = mirror_clip(clip, partners)
    both = [joint for joint in range(skeleton.joint_count) if joint != weapon]
    expected = global_positions(clip)[:, partners] * REFLECTED
    np.testing.assert_allclose(global_positions(mirrored)[:, both], expected[:, both], atol=2e-6)
    assert quaternions.angle_between(mirrored.rotations[:, weapon], clip.rotations[:, weapon]).max() < 1e-3
    assert skeleton.parents[weapon] == hand
    assert same_motion(mirror_clip(mirrored, partners), clip)


def test_what_hangs_from_a_joint_without_a_counterpart_keeps_its_place_and_turn_in_it() -> None:
    plain = game_skeleton()
    weapon, count = plain.index_of("weapon_r"), plain.joint_count
    skeleton = Skeleton(
        (*plain.joint_names, "blade"),
        np.append(plain.parents, weapon),
        np.concatenate((plain.offsets, [[0.1, 0.3, 0.5]])),
        np.concatenate((plain.rest_rotations, quaternions.identity(1))),
    )
    partners = np.append(partners_of(plain), count)
    clip = wild(skeleton, 7, translated=(weapon, count))
    mirrored = mirror_clip(clip, partners)
    assert mirrored.translated_joints == (weapon, count)
    np.testing.assert_array_equal(mirrored.translations, clip.translations)
    turned = quaternions.angle_between(mirrored.rotations[:, [weapon, count]], clip.rotations[:, [weapon, count]])
    assert turned.max() < 1e-3


@pytest.mark.parametrize("make", [studio_skeleton, own_axes, raised_arm], ids=["plain", "own axes", "asymmetric rest"])
def test_tips_are_where_the_mirror_shows_those_of_their_partners(make: Callable[..., Any]) -> None:
    skeleton, partners = make(), partners_of(studio_skeleton())
    clip, joints = wild(skeleton, 8), [site.joint for site in skeleton.end_sites]
    mirrored, seen = (
        global_positions(one, end_sites=True)[:, skeleton.joint_count :] for one in (mirror_clip(clip, partners), clip)
    )
    others = [joints.index(partners[joint]) for joint in joints]
    assert len(joints) > 2
    np.testing.assert_allclose(mirrored, seen[:, others] * REFLECTED, atol=2e-6)


@pytest.mark.parametrize("make", [studio_skeleton, own_axes], ids=["plain", "own axes"])
def test_translations_are_mirrored_even_where_only_one_side_has_them(make: Callable[..., Any]) -> None:
    skeleton = make()
    plain = studio_skeleton()
    partners = partners_of(plain)
    left = tuple(sorted(plain.index_of(name) for name in ("Spine1", "LeftArm", "LeftFoot")))
    clip = wild(skeleton, 5, translated=left)
    mirrored = mirror_clip(clip, partners)
    assert set(mirrored.translated_joints) == {*left, plain.index_of("RightArm"), plain.index_of("RightFoot")}
    np.testing.assert_allclose(global_positions(mirrored), global_positions(clip)[:, partners] * REFLECTED, atol=5e-6)
    assert same_motion(mirror_clip(mirrored, partners), clip)


def test_a_left_turn_in_the_mirror_is_a_right_turn() -> None:
    left, right = generate_gait(1.2, 0.8, 4.0), generate_gait(1.2, -0.8, 4.0)
    mirrored = mirror_clip(left, partners_of(left.skeleton))
    np.testing.assert_allclose(mirrored.root_translations[:, [0, 2]], right.root_translations[:, [0, 2]], atol=1e-6)
    assert np.linalg.norm(left.root_translations[-1, [0, 2]] - right.root_translations[-1, [0, 2]]) > 2.0


@pytest.mark.parametrize(
    ("partners", "message"),
    [
        ([0, 1], "no two joints may have the same"),
        ([0, 2, 2], "no two joints may have the same"),
        ([1, 0, 2], "the root must be its own partner"),
    ],
)
def test_what_is_no_pairing_is_refused(partners: list[int], message: str) -> None:
    skeleton = Skeleton(
        ("a", "b", "c"), np.array([-1, 0, 0], np.int32), np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1))
    )
    with pytest.raises(MotionError, match=message):
        mirror_clip(wild(skeleton, 6), np.array(partners))
