"""Retargeting of a motion to another body."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.support.judged_rigs import Actor, JudgedRetargeting, degrees_between, plan_between
from tests.support.present import present
from tests.support.tiers import is_soak

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError, MappingError, UnknownJoint
from marey_motion.formats import read_motion
from marey_motion.gait import game_skeleton, generate_gait, studio_skeleton
from marey_motion.importing.checks import CODES, CheckWarning
from marey_motion.moved_bones import LEAST_TURN_DEG, SHORTEST_BONE_M, follow_moved_bones
from marey_motion.retargeting import JointPair, RetargetPlan, plan_retarget, retarget, retarget_with_checks
from marey_motion.retargeting.soles import SOLES_OFF_M
from marey_motion.retargeting.transferring import transfer
from marey_motion.retargeting.trunk import HIP_LINE_DEG
from marey_motion.rigs import JointAxes, map_joints
from marey_motion.rigs.axes import bone_end
from marey_motion.skeleton import Skeleton
from marey_schemas.options.retargeting import RetargetOptions

SIDES = ("left", "right")
# Bones that every rig has without joints between, so that joint and child show the twist axis to the eye.
LIMBS = [
    (f"{side}_{start}", f"{side}_{end}")
    for side in SIDES
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
MOVED_BONES, SOLES = "bones-moved-by-translations", "soles-moved-to-floor"
HIP_LINE, DROPPED = "pelvis-from-hip-line", "dropped-joints-followed"
FOLDERS = ("cmu-amc/16", "bandai-namco-2", "snu-mss", "game-engine")


def resting(skeleton: Skeleton) -> Clip:
    """Return a clip of one frame in the rest pose."""
    return Clip(skeleton, 60.0, np.concatenate((skeleton.offsets[0], skeleton.rest_rotations.ravel()))[None])


def tumbling(skeleton: Skeleton, frames: int = 200, seed: int = 4) -> Clip:
    """Return a clip of random rotations that no real body can perform; some of the rotations are half turns."""
    generator = np.random.default_rng(seed)
    rotations = quaternions.normalise(generator.normal(size=(frames, skeleton.joint_count, 4)))
    rotations[0] = quaternions.identity()
    rotations[1:4, :] = np.eye(4)[1:, None]
    poses = np.concatenate((generator.normal(size=(frames, 3)), rotations.reshape(frames, -1)), axis=1)
    return Clip(skeleton, 60.0, poses)


@pytest.fixture(scope="module")
def studio() -> Actor:
    return Actor(generate_gait(1.3, 0.6, 3.0))


@pytest.fixture(scope="module")
def game() -> Actor:
    return Actor(resting(game_skeleton()))


@pytest.fixture(scope="module")
def real(mocap: Path) -> dict[str, Actor]:
    """A take of each of four capture systems, by folder."""

    return {
        "cmu-amc/16": Actor.of(mocap, "cmu-amc/16/16_15.amc"),
        "bandai-namco-2": Actor.of(mocap, "bandai-namco-2/dataset-2_walk-turn-left_normal_003.bvh"),
        "snu-mss": Actor.of(mocap, "rigs/snu-mss/walk_fullbody.bvh"),
        "game-engine": Actor.of(mocap, "rigs/game-engine/custom_skeleton_walk_example.bvh"),
    }


def bone_directions(clip: Clip, start: int, end: int) -> AnyFloats:
    positions = kinematics.global_positions(clip).astype(np.float64)
    return positions[:, end] - positions[:, start]


def axis_directions(clip: Clip, joint: int, axis: tuple[float, float, float]) -> AnyFloats:
    rotations = kinematics.global_rotations(clip).astype(np.float64)
    return quaternions.rotate_vectors(rotations[:, joint], axis)


def pairs_as_in(clip: Clip, plan: RetargetPlan) -> list[JointPair]:
    """List the joint pairs that copy the orientation of the source: all except those that replace dropped joints."""
    check = check_of(clip, plan, DROPPED)
    return [pair for pair in plan.pairs if check is None or pair.source not in check.joints]


def assert_bones_point_alike(
    source: Actor, target: Actor, result: Clip, plan: RetargetPlan, tolerance_deg: float = 1e-3
) -> None:
    for start, end in LIMBS:
        expected = bone_directions(source.clip, source.joint(start), source.joint(end))
        found = bone_directions(result, target.joint(start), target.joint(end))
        assert degrees_between(expected, found).max() < tolerance_deg, (start, end)
    for pair in pairs_as_in(source.clip, plan):
        for axis in ("twist", "swing"):
            expected = axis_directions(
                source.clip, source.skeleton.index_of(pair.source), getattr(source.axes[pair.source], axis)
            )
            found = axis_directions(
                result, target.skeleton.index_of(pair.target), getattr(target.axes[pair.target], axis)
            )
            assert degrees_between(expected, found).max() < tolerance_deg, (pair, axis)


def assert_no_flips_of_its_own(source: Actor, result: Clip, plan: RetargetPlan) -> None:
    """Check that mapped joints rotate from frame to frame as in the source, and that no quaternion changes its sign."""
    before = kinematics.global_rotations(source.clip).astype(np.float64)
    after = kinematics.global_rotations(result).astype(np.float64)
    for pair in pairs_as_in(source.clip, plan):
        turned, turns = (
            np.degrees(quaternions.angle_between(rotations[1:, joint], rotations[:-1, joint]))
            for rotations, joint in (
                (before, source.skeleton.index_of(pair.source)),
                (after, result.skeleton.index_of(pair.target)),
            )
        )
        assert np.abs(turns - turned).max() < 0.1, pair
    assert np.sum(result.rotations[1:] * result.rotations[:-1], axis=-1).min() >= 0.0


def assert_changes_nothing(plan: RetargetPlan) -> None:
    assert np.abs(plan.corrections - quaternions.identity(len(plan.corrections))).max() < 1e-12
    assert plan.scale == pytest.approx(1.0, rel=0, abs=1e-12)


def check_of(clip: Clip, plan: RetargetPlan, code: str) -> CheckWarning | None:
    """Return the check with a code that retargeting a clip gives, or None."""
    return next((check for check in retarget_with_checks(clip, plan).checks if check.code == code), None)


def assert_body_travels(source: Actor, target: Actor, clip: Clip, result: Clip, plan: RetargetPlan) -> None:
    """Check that the anchor of the result moves as in the source, times the scale, apart from the reported shift."""
    anchors = [anchor.standard for anchor in plan.anchors]
    expected, found = (
        kinematics.global_positions(one)[:, [actor.joint(anchor) for anchor in anchors]].astype(np.float64).mean(axis=1)
        for actor, one in ((source, clip), (target, result))
    )
    check = check_of(clip, plan, SOLES)
    moved = (0.0, 0.0 if check is None else check.values["moved_m"], 0.0)
    assert np.abs(found - plan.scale * expected - moved).max() < 1e-6


def assert_same_motion(result: Clip, expected: Clip, least_m: float = 1e-6) -> None:
    angles = quaternions.angle_between(result.rotations.astype(float), expected.rotations.astype(float))
    assert angles.max() < 1e-6
    moved = np.abs(result.root_translations - expected.root_translations)
    assert moved.max() < least_m
    assert moved[:, (0, 2)].max() < 1e-6


def after_rest_pose(clip: Clip) -> Clip:
    """Return the clip with the rest pose as an additional first frame."""
    return Clip(
        clip.skeleton, clip.frame_rate_hz, np.concatenate((resting(clip.skeleton).poses, clip.poses), dtype=np.float32)
    )


def with_lowered_arms(skeleton: Skeleton, angle_deg: float) -> Skeleton:
    """Return the skeleton with both arms lowered at rest; `skeleton` stretches the arms out sideways."""
    rest = skeleton.rest_rotations.copy()
    for name, sign in (("LeftArm", -1.0), ("RightArm", 1.0)):
        arm = skeleton.index_of(name)
        lowering = quaternions.from_axis_angle((0.0, 0.0, 1.0), sign * np.radians(angle_deg))
        rest[arm] = quaternions.multiply(lowering, rest[arm])
    return replace(skeleton, rest_rotations=rest)


def algorithm_1(source: SimpleNamespace, source_global: Floats, target: Actor, plan: RetargetPlan) -> Floats:
    """Return the local rotations (K, 4) of one pose, computed joint by joint (Herrmann et al. 2019, Algorithm 1).

    `source_global` (J, 4) are the rotations of the joints of the source in this pose.
    """
    target_global = quaternions.identity(target.skeleton.joint_count)
    local = target.skeleton.rest_rotations.copy()
    followed = {pair.target: pair.source for pair in plan.pairs}
    for joint, name in enumerate(target.skeleton.joint_names):
        parent = target.skeleton.parents[joint]
        inherited = target_global[parent] if parent >= 0 else quaternions.identity()
        if name in followed:
            turn = source_global[source.skeleton.index_of(followed[name])]
            twist, swing = (
                quaternions.rotate_vectors(turn, axis)
                for axis in (source.axes[followed[name]].twist, source.axes[followed[name]].swing)
            )
            own = target.axes[name]
            q_y = quaternions.between_vectors(own.twist, twist, half_turn_axis=own.swing)
            carried = quaternions.rotate_vectors(q_y, own.swing)
            sine = np.dot(np.cross(carried, swing), twist)
            q_x = quaternions.from_axis_angle(twist, np.arctan2(sine, np.dot(carried, swing)))
            local[joint] = quaternions.multiply(quaternions.conjugate(inherited), quaternions.multiply(q_x, q_y))
        target_global[joint] = quaternions.multiply(inherited, local[joint])
    return local


def test_the_precomputed_corrections_equal_algorithm_1_done_pose_by_pose(studio: Actor, game: Actor) -> None:
    for source, target in ((studio, game), (game, studio)):
        moving = SimpleNamespace(clip=tumbling(source.skeleton), skeleton=source.skeleton, axes=source.axes)
        plan = plan_between(source, target)
        result = transfer(moving.clip, plan, moving.clip.poses[:, 3:])

        globally = kinematics.global_rotations(moving.clip).astype(np.float64)
        frames = range(moving.clip.frame_count)
        for frame in frames if is_soak() else (*frames[:6], *frames[6::10]):  # the first ones are the half turns
            expected = algorithm_1(moving, globally[frame], target, plan)
            assert quaternions.angle_between(result.rotations[frame].astype(float), expected).max() < 1e-5


def test_the_same_skeleton_gives_the_same_motion(studio: Actor, game: Actor) -> None:
    for actor, clip in ((studio, studio.clip), (game, tumbling(game.skeleton))):
        plan = plan_between(actor, actor)
        assert_changes_nothing(plan)
        result = retarget(clip, plan)

        angles = quaternions.angle_between(result.rotations.astype(float), clip.rotations.astype(float))
        assert angles.max() < 1e-6
        assert np.sum(result.rotations[0] * clip.rotations[0], axis=-1).min() > 0.0
        assert_body_travels(actor, actor, clip, result, plan)


def test_every_joint_of_a_copy_is_carried_along_mapped_or_not(game: Actor) -> None:
    smaller = Actor(resting(replace(game.skeleton, offsets=0.8 * game.skeleton.offsets)))
    plan = plan_between(game, smaller)

    assert plan.at_rest == ()
    assert "weapon_r" in plan.carried
    clip = tumbling(game.skeleton)
    result = retarget(clip, plan)
    assert quaternions.angle_between(result.rotations.astype(float), clip.rotations.astype(float)).max() < 1e-6


def test_a_clip_in_which_nothing_is_wrong_is_what_the_transfer_makes_to_the_bit(studio: Actor, game: Actor) -> None:
    smaller = Actor(resting(studio_skeleton(1.5)))
    for source, target in ((studio, smaller), (studio, studio)):
        plan = plan_between(source, target)
        made = retarget_with_checks(source.clip, plan)

        assert made.checks == ()
        assert np.array_equal(made.clip.poses, transfer(source.clip, plan, source.clip.poses[:, 3:]).poses)


def test_bones_point_where_the_source_points_them_on_another_rig(studio: Actor, game: Actor) -> None:
    plan = plan_between(studio, game)
    result = retarget(studio.clip, plan)

    assert_bones_point_alike(studio, game, result, plan)
    assert_no_flips_of_its_own(studio, result, plan)
    assert result.skeleton is game.skeleton
    assert result.frame_rate_hz == studio.clip.frame_rate_hz


def test_there_and_back_returns_the_mapped_joints(studio: Actor, game: Actor) -> None:
    there = retarget(studio.clip, plan_between(studio, game))
    back = retarget(there, plan_between(game, studio))

    angles = quaternions.angle_between(back.rotations.astype(float), studio.clip.rotations.astype(float))
    assert np.degrees(angles.max()) < 0.001
    assert np.abs(back.root_translations - studio.clip.root_translations).max() < 1e-5


@pytest.mark.parametrize("stature_m", [1.1, 1.5, 2.1])
def test_scaled_copies_keep_the_height_of_their_feet_in_proportion(studio: Actor, stature_m: float) -> None:
    copy = Actor(resting(studio_skeleton(stature_m)))
    plan = plan_between(studio, copy)
    result = retarget(studio.clip, plan)

    assert plan.scale == pytest.approx(stature_m / 1.78, rel=1e-12)
    expected = kinematics.global_positions(studio.clip, end_sites=True) * plan.scale
    assert np.abs(kinematics.global_positions(result, end_sites=True) - expected).max() < 1e-5


def test_the_feet_of_another_body_stay_on_the_floor(studio: Actor, game: Actor) -> None:
    result = retarget(studio.clip, plan_between(studio, game))

    toes = [game.joint(f"{side}_toe") for side in SIDES]
    heights = kinematics.global_positions(result)[:, toes, 1]
    assert 0.01 < heights.min() < 0.03


def test_an_explicit_scale_is_used_for_the_travel_while_the_soles_stay_on_the_floor(studio: Actor, game: Actor) -> None:
    plan = plan_between(studio, game, scale=2.0)
    result = retarget(studio.clip, plan)

    assert_body_travels(studio, game, studio.clip, result, plan)
    pelvis = kinematics.global_positions(result)[:, game.joint("pelvis")]
    assert np.abs(pelvis - 2.0 * studio.clip.root_translations)[:, (0, 2)].max() < 1e-5
    assert abs(JudgedRetargeting(studio, game, result, plan.scale).soles_off_m) < 1e-3


def test_unmapped_joints_rest_and_the_plan_names_them(studio: Actor, game: Actor) -> None:
    plan = plan_between(studio, game)
    result = retarget(studio.clip, plan)

    assert {"weapon_r", "upperarm_twist_01_l", "root"} <= set(plan.at_rest)
    assert "left_hip" in {pair.standard for pair in plan.pairs}
    for name in plan.at_rest:
        joint = game.skeleton.index_of(name)
        angles = quaternions.angle_between(
            result.rotations[:, joint].astype(float), game.skeleton.rest_rotations[joint]
        )
        assert angles.max() < 1e-6


def test_each_frame_depends_on_itself_alone_and_no_frame_is_a_reference_pose(studio: Actor, game: Actor) -> None:
    plan = plan_between(studio, game)
    whole = retarget(studio.clip, plan)
    part = retarget(studio.clip.sliced(70, 120), plan)

    assert_same_motion(part, whole.sliced(70, 120))


def test_a_rest_pose_before_the_clip_changes_no_frame_after_it(studio: Actor, game: Actor) -> None:
    longer = Actor(after_rest_pose(studio.clip))
    assert_same_motion(
        retarget(longer.clip, plan_between(longer, game)).sliced(1, longer.clip.frame_count),
        retarget(studio.clip, plan_between(studio, game)),
    )


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 70.0])
def test_a_rest_pose_with_lower_arms_moves_another_body_alike(studio: Actor, game: Actor, angle_deg: float) -> None:
    lowered = Actor(replace(studio.clip, skeleton=with_lowered_arms(studio.skeleton, angle_deg)))
    expected, found = (retarget(actor.clip, plan_between(actor, game)) for actor in (studio, lowered))

    turns = [kinematics.global_rotations(clip).astype(np.float64) for clip in (expected, found)]
    assert np.degrees(quaternions.angle_between(*turns).max()) < 1.5


def test_signs_stay_continuous_when_the_source_flips_its_own(studio: Actor, game: Actor) -> None:
    poses = studio.clip.poses.copy()
    poses[1::2, 3:] *= -1.0
    result = retarget(replace(studio.clip, poses=poses), plan_between(studio, game))

    assert np.sum(result.rotations[1:] * result.rotations[:-1], axis=-1).min() > 0.0


def test_translations_of_the_source_move_its_pelvis_but_stretch_no_bone(game: Actor, studio: Actor) -> None:
    clip = tumbling(game.skeleton, 5)
    pelvis, knee = game.joint("pelvis"), game.joint("left_knee")
    shift = np.zeros((5, 2, 3))
    shift[:, 0], shift[:, 1] = (0.3, -0.2, 0.5), 1.5 * game.skeleton.offsets[knee]
    stretched = replace(clip, translations=shift.astype(np.float32), translated_joints=(pelvis, knee))
    plan = plan_between(game, studio)
    result, plain = retarget(stretched, plan), retarget(clip, plan)

    assert np.abs(result.rotations - plain.rotations).max() < 1e-5
    assert check_of(stretched, plan, MOVED_BONES) is None
    expected = plan.scale * kinematics.global_positions(stretched)[:, pelvis]
    assert np.abs(result.root_translations - expected).max() < 1e-5


def with_moved_joints(actor: Actor, *standards: Any, by_m: float = 0.08) -> Clip:
    """Return the actor's clip with joints that move relative to their parents, each in a different way."""
    joints = sorted(actor.joint(standard) for standard in standards)
    time = np.arange(actor.clip.frame_count)[:, None, None] / 20.0
    ways = by_m * np.sin(time + np.arange(3 * len(joints)).reshape(1, -1, 3))
    moved = actor.skeleton.offsets[joints] + ways
    return replace(actor.clip, translations=moved.astype(np.float32), translated_joints=tuple(joints))


@pytest.mark.parametrize("side", ["left", "right"])
def test_bones_point_where_translations_of_the_source_point_them(studio: Actor, game: Actor, side: str) -> None:
    clip = with_moved_joints(studio, *(f"{side}_{joint}" for joint in ("elbow", "wrist", "knee", "ankle")))
    result = retarget(clip, plan_between(studio, game))

    for start, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
        start, end = f"{side}_{start}", f"{side}_{end}"
        source, plain = (bone_directions(one, studio.joint(start), studio.joint(end)) for one in (clip, studio.clip))
        found = bone_directions(result, game.joint(start), game.joint(end))
        assert degrees_between(source, plain).max() > 5.0
        assert degrees_between(source, found).max() < 0.01


def test_bones_that_translations_moved_are_told_with_their_joints(studio: Actor, game: Actor) -> None:
    clip, plan = with_moved_joints(studio, "left_elbow"), plan_between(studio, game)
    warning = check_of(clip, plan, MOVED_BONES)

    assert warning is not None
    assert warning.code in CODES
    assert set(warning.joints) == {studio.mapping.joints["left_shoulder"]}
    assert 5.0 < warning.values["largest_turn_deg"] < 45.0
    assert check_of(studio.clip, plan, MOVED_BONES) is None


@pytest.mark.parametrize("angle_deg", [8.0, 60.0, 98.0])
def test_the_pelvis_follows_the_line_between_the_hips_where_they_disagree(
    studio: Actor, game: Actor, angle_deg: float
) -> None:
    hips = [studio.joint(f"{side}_hip") for side in SIDES]
    turn = quaternions.from_axis_angle((0.0, 1.0, 0.0), np.radians(angle_deg))
    places = np.tile(quaternions.rotate_vectors(turn, studio.skeleton.offsets[hips]), (studio.clip.frame_count, 1, 1))
    clip = replace(studio.clip, translations=places.astype(np.float32), translated_joints=tuple(sorted(hips)))
    plan = plan_between(studio, game)
    result, check = retarget(clip, plan), check_of(clip, plan, HIP_LINE)

    line = bone_directions(result, game.joint("right_hip"), game.joint("left_hip"))
    off = degrees_between(line, bone_directions(clip, studio.joint("right_hip"), studio.joint("left_hip")))
    if angle_deg < HIP_LINE_DEG:
        assert check is None
        assert off == pytest.approx(angle_deg, abs=0.1)
        return
    assert check is not None
    assert check.values["largest_turn_deg"] == pytest.approx(angle_deg, abs=0.1)
    assert off.max() < 0.01
    plain = retarget(studio.clip, plan)
    for start, end in LIMBS:
        legs = (bone_directions(one, game.joint(start), game.joint(end)) for one in (result, plain))
        assert degrees_between(*legs).max() < 1e-2, "only the pelvis turns"


def test_a_rig_whose_hips_a_dance_twists_keeps_its_legs_apart(mocap: Path, game: Actor) -> None:
    dancer = Actor.of(mocap, "rigs/makehuman/dance1.bvh")
    plan = plan_between(dancer, game)
    judged = JudgedRetargeting(dancer, game, retarget(dancer.clip, plan), plan.scale)

    check = check_of(dancer.clip, plan, HIP_LINE)
    assert check is not None
    assert check.values["largest_turn_deg"] == pytest.approx(18.9, abs=0.1)
    assert judged.off_deg("right_hip", "left_hip") < 0.01


def bones_followed_by_numpy(clip: Clip, joints: dict[str, int]) -> tuple[AnyFloats, dict[str, float]]:
    """Return what `follow_moved_bones` returns, computed in numpy: rotations (F, 4·J) and largest turns in degrees."""
    still = replace(clip, translations=None, translated_joints=())
    rigid, moved = (kinematics.global_positions(one).astype(np.float64) for one in (still, clip))
    turned, largest = kinematics.global_rotations(clip).astype(np.float64), {}
    for standard, joint in joints.items():
        end, name = bone_end(standard, joints), clip.skeleton.joint_names[joint]
        if end is None or name in largest:
            continue
        ways = [points[:, joints[end]] - points[:, joint] for points in (rigid, moved)]
        turns = quaternions.identity(clip.frame_count).astype(np.float64)
        known = np.minimum(*(np.linalg.norm(way, axis=1) for way in ways)) > SHORTEST_BONE_M
        turns[known] = quaternions.between_vectors(*(way[known] for way in ways))
        most = float(np.degrees(quaternions.angle_between(turns, quaternions.identity(len(turns)))).max())
        if most >= LEAST_TURN_DEG:
            largest[name] = most
            turned[:, joint] = quaternions.multiply(turns, turned[:, joint])
    local = kinematics.as_local_rotations(clip.skeleton, turned)
    return local.reshape(clip.frame_count, -1).astype(np.float32), largest


def test_bones_are_turned_to_the_bit_as_numpy_turns_them(studio: Actor) -> None:
    clip = with_moved_joints(studio, "left_elbow", "right_wrist", "left_knee", "right_ankle", "left_ankle")
    elbow, wrist = (clip.translated_joints.index(studio.joint(name)) for name in ("left_elbow", "right_wrist"))
    translations = present(clip.translations).copy()
    translations[5, elbow] = 0.0  # no length
    translations[7:11, elbow] *= -1.0
    translations[8, wrist] = -clip.skeleton.offsets[studio.joint("right_wrist")]  # half a circle
    clip = replace(clip, translations=translations)
    joints = {name: clip.skeleton.index_of(joint) for name, joint in studio.mapping.joints.items()}

    found, (rotations, largest) = follow_moved_bones(clip, joints), bones_followed_by_numpy(clip, joints)

    assert found.largest_turn_deg == largest
    assert len(largest) == 5
    assert max(largest.values()) > 179.0
    assert found.rotations.tobytes() == rotations.tobytes()


def test_a_bone_beyond_the_range_of_single_precision_does_not_turn(studio: Actor) -> None:
    clip = with_moved_joints(studio, "left_knee", "left_ankle", "left_toe")
    translations = present(clip.translations).copy()
    translations[5, :2] = 3e38  # ankle and toe are infinitely far away, so that the bone between them has no direction
    clip = replace(clip, translations=translations)
    joints = {name: studio.joint(name) for name in ("left_ankle", "left_toe")}

    found = follow_moved_bones(clip, joints)
    with np.errstate(invalid="ignore"):
        rotations, largest = bones_followed_by_numpy(clip, joints)

    assert found.largest_turn_deg == largest
    assert len(largest) == 1
    assert found.rotations.tobytes() == rotations.tobytes()


def test_a_clip_keeps_the_translations_of_its_joints_on_its_own_skeleton(studio: Actor) -> None:
    clip, plan = with_moved_joints(studio, "left_elbow", "left_knee"), plan_between(studio, studio)
    result = retarget(clip, plan)

    assert check_of(clip, plan, MOVED_BONES) is None
    assert result.translated_joints == clip.translated_joints
    assert np.abs(kinematics.global_positions(result) - kinematics.global_positions(clip)).max() < 1e-6
    assert quaternions.angle_between(result.rotations, clip.rotations).max() < 1e-6


def test_a_joint_that_moves_onto_its_parent_leaves_the_bone_as_its_rotation_has_it(studio: Actor, game: Actor) -> None:
    elbow = studio.joint("left_elbow")
    still = np.zeros((studio.clip.frame_count, 1, 3), dtype=np.float32)
    clip = replace(studio.clip, translations=still, translated_joints=(elbow,))
    plan = plan_between(studio, game)

    assert np.array_equal(retarget(clip, plan).rotations, retarget(studio.clip, plan).rotations)


def test_the_same_clip_gives_the_same_bytes(studio: Actor, game: Actor) -> None:
    first, second = (retarget(studio.clip, plan_between(studio, game)) for _ in range(2))

    assert first.poses.tobytes() == second.poses.tobytes()


def test_too_small_a_mapping_is_refused_with_what_is_missing(studio: Actor, game: Actor) -> None:
    few = {name: game.mapping.joints[name] for name in ("root", "pelvis", "left_hip", "right_hip", "head")}

    with pytest.raises(MappingError) as error:
        plan_retarget(
            studio.skeleton,
            studio.mapping,
            studio.axes,
            game.skeleton,
            replace(game.mapping, joints=few),
            game.axes,
        )
    assert "target skeleton's mapping has no left_knee" in str(error.value)
    assert "source" not in str(error.value)
    assert "Correct the joint mappings" in str(error.value)


def test_a_mapping_with_one_joint_for_most_standard_joints_is_refused(studio: Actor, game: Actor) -> None:
    pelvis = game.mapping.joints["pelvis"]
    same = {name: joint if name == "head" else pelvis for name, joint in game.mapping.joints.items()}
    mapped = SimpleNamespace(skeleton=game.skeleton, mapping=replace(game.mapping, joints=same), axes=game.axes)
    with pytest.raises(MappingError, match="names one joint for several standard joints"):
        plan_between(studio, mapped, scale=1.0)


@pytest.mark.parametrize(("kept", "without"), [("keep_feet", "left_knee"), ("keep_hands", "right_elbow")])
def test_feet_or_hands_of_limbs_that_are_not_mapped_cannot_be_kept(
    studio: Actor, game: Actor, kept: str, without: str
) -> None:
    joints = {standard: name for standard, name in studio.mapping.joints.items() if standard != without}
    lacking = SimpleNamespace(
        skeleton=studio.skeleton, mapping=replace(studio.mapping, joints=joints), axes=studio.axes
    )
    plan = plan_between(lacking, game, scale=1.0)

    retarget(studio.clip, plan)
    end = without.replace("knee", "ankle").replace("elbow", "wrist")
    advice = f"no complete limb ends at {end}; map these joints, or leave the option out"
    with pytest.raises(MappingError, match=advice):
        retarget_with_checks(studio.clip, plan, RetargetOptions.model_validate({kept: True}))


def test_feet_and_hands_of_a_single_frame_are_kept(mocap: Path, game: Actor) -> None:
    dancer = Actor.of(mocap, "rigs/makehuman/dance1.bvh")
    made = retarget_with_checks(
        dancer.clip, plan_between(dancer, game), RetargetOptions(keep_feet=True, keep_hands=True)
    )

    assert made.clip.frame_count == 1
    assert {"feet-kept", "hands-kept"} <= {check.code for check in made.checks}


def test_a_mapping_without_a_pelvis_is_refused(studio: Actor, game: Actor) -> None:
    joints = {name: joint for name, joint in studio.mapping.joints.items() if name != "pelvis"}

    with pytest.raises(MappingError, match="source skeleton's mapping has no pelvis"):
        plan_between(
            SimpleNamespace(skeleton=studio.skeleton, mapping=replace(studio.mapping, joints=joints), axes=studio.axes),
            game,
        )


def test_a_mapping_to_a_joint_that_is_not_there_is_refused_by_name(studio: Actor, game: Actor) -> None:
    joints = {**studio.mapping.joints, "head": "Haed"}

    with pytest.raises(UnknownJoint, match="did you mean Head"):
        plan_between(
            SimpleNamespace(skeleton=studio.skeleton, mapping=replace(studio.mapping, joints=joints), axes=studio.axes),
            game,
        )


def test_bodies_without_legs_need_an_explicit_scale(studio: Actor, game: Actor) -> None:
    joints = {name: joint for name, joint in studio.mapping.joints.items() if "knee" not in name}
    crippled = SimpleNamespace(
        skeleton=studio.skeleton, mapping=replace(studio.mapping, joints=joints), axes=studio.axes
    )

    with pytest.raises(MappingError, match="with --scale or the parameter scale"):
        plan_between(crippled, game)
    assert plan_between(crippled, game, scale=1.5).scale == 1.5


def test_legs_without_length_need_an_explicit_scale(studio: Actor, game: Actor) -> None:
    offsets = studio.skeleton.offsets.copy()
    for side in SIDES:
        offsets[[studio.joint(f"{side}_{joint}") for joint in ("hip", "knee", "ankle", "toe")]] = 0.0
    legless = SimpleNamespace(
        skeleton=replace(studio.skeleton, offsets=offsets), mapping=studio.mapping, axes=studio.axes
    )

    with pytest.raises(MappingError, match="with --scale or the parameter scale"):
        plan_between(legless, game)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_must_be_positive(studio: Actor, game: Actor, scale: float) -> None:
    with pytest.raises(MappingError, match="positive"):
        plan_between(studio, game, scale=scale)


def test_missing_or_parallel_axes_are_refused_by_the_joint_they_are_missing_for(studio: Actor, game: Actor) -> None:
    without = {name: axes for name, axes in game.axes.items() if name != "calf_l"}
    parallel = {**game.axes, "calf_l": JointAxes((1.0, 0.0, 0.0), (2.0, 0.0, 0.0))}

    for axes in (without, parallel):
        with pytest.raises(MappingError, match="calf_l"):
            plan_between(studio, SimpleNamespace(skeleton=game.skeleton, mapping=game.mapping, axes=axes))


def test_a_clip_of_another_skeleton_than_planned_is_refused(studio: Actor, game: Actor) -> None:
    with pytest.raises(ClipError, match="a different skeleton"):
        retarget(studio.clip, plan_between(game, studio))


def test_skeletons_of_one_joint_are_refused(studio: Actor) -> None:
    stick = Skeleton(("stick",), np.array([-1]), np.zeros((1, 3)), np.array([(1.0, 0.0, 0.0, 0.0)]))

    with pytest.raises(MappingError, match="no pelvis"):
        plan_between(studio, SimpleNamespace(skeleton=stick, mapping=map_joints(stick), axes={}))


@pytest.mark.parametrize("folder", FOLDERS)
def test_real_motion_on_its_own_skeleton_stays_as_it_is(real: dict[str, Actor], folder: str) -> None:
    actor = real[folder]
    plan = plan_between(actor, actor)
    assert_changes_nothing(plan)
    result = retarget(actor.clip, plan)

    angles = quaternions.angle_between(result.rotations.astype(float), actor.clip.rotations.astype(float))
    assert angles.max() < 1e-6
    assert_body_travels(actor, actor, actor.clip, result, plan)


@pytest.mark.parametrize("folder", ["cmu-amc/16", "snu-mss"])
def test_a_rest_pose_that_stands_changes_no_frame_of_a_real_clip_after_it(
    real: dict[str, Actor], game: Actor, folder: str
) -> None:
    longer = Actor(after_rest_pose(real[folder].clip))
    assert_same_motion(
        retarget(longer.clip, plan_between(longer, game)).sliced(1, longer.clip.frame_count),
        retarget(real[folder].clip, plan_between(real[folder], game)),
        least_m=1e-3,  # the height of the floor is a median over the clip
    )


@pytest.mark.parametrize(("from_folder", "to_folder"), list(permutations(FOLDERS, 2)))
def test_real_motion_points_all_bones_alike_on_another_rig(
    real: dict[str, Actor], from_folder: str, to_folder: str
) -> None:
    source, target = real[from_folder], real[to_folder]
    plan = plan_between(source, target)
    result = retarget(source.clip, plan)

    assert len(plan.pairs) >= 20
    assert np.isfinite(result.poses).all()
    assert_bones_point_alike(source, target, result, plan)
    assert_no_flips_of_its_own(source, result, plan)
    assert_body_travels(source, target, source.clip, result, plan)


@pytest.mark.parametrize(("from_folder", "to_folder"), list(permutations(FOLDERS, 2)))
def test_real_soles_keep_their_height_over_the_floor(real: dict[str, Actor], from_folder: str, to_folder: str) -> None:
    source, target = real[from_folder], real[to_folder]
    plan = plan_between(source, target)
    result = retarget(source.clip, plan)

    assert abs(JudgedRetargeting(source, target, result, plan.scale).soles_off_m) < 0.015


def test_the_hip_height_of_a_rig_that_lies_folded_at_rest_is_that_of_its_legs(mocap: Path, studio: Actor) -> None:
    path = mocap / "rigs/game-engine/vis_example.bvh"  # its thighs are drawn above the pelvis at rest
    folded = Actor(present(read_motion(path.read_bytes(), path.name).clip))
    legs = [
        sum(np.linalg.norm(actor.skeleton.offsets[actor.joint(f"left_{joint}")]) for joint in ("knee", "ankle"))
        for actor in (folded, studio)
    ]

    assert plan_between(folded, studio).scale == pytest.approx(legs[1] / legs[0], rel=0.03)


@pytest.mark.parametrize(("from_folder", "to_folder"), list(permutations(FOLDERS, 2)))
def test_real_motion_there_and_back_returns_the_mapped_joints(
    real: dict[str, Actor], from_folder: str, to_folder: str
) -> None:
    source, target = real[from_folder], real[to_folder]
    plan = plan_between(source, target)
    back = retarget(retarget(source.clip, plan), plan_between(target, source))

    before, after = (kinematics.global_rotations(clip).astype(np.float64) for clip in (source.clip, back))
    followed = {pair.source for pair in pairs_as_in(source.clip, plan)}
    for name in followed:
        joint = source.skeleton.index_of(name)
        assert np.degrees(quaternions.angle_between(before[:, joint], after[:, joint]).max()) < 0.1, name
        if source.skeleton.joint_names[source.skeleton.parents[joint]] in followed:
            local = quaternions.angle_between(
                source.clip.rotations[:, joint].astype(float), back.rotations[:, joint].astype(float)
            )
            assert np.degrees(local.max()) < 0.1, name
    pelvis = source.joint("pelvis")
    moved = kinematics.global_positions(back)[:, pelvis] - kinematics.global_positions(source.clip)[:, pelvis]
    assert np.abs(moved[:, (0, 2)]).max() < 1e-4
    assert np.abs(moved[:, 1]).max() < SOLES_OFF_M
