"""Recognition of known rigs by names and of unknown rigs by proportions; animals are not taken for humans."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.errors import MappingError
from marey_motion.gait import studio_skeleton
from marey_motion.rigs import ESSENTIAL_JOINTS, STANDARD_JOINTS, map_joints, mirrored, require_trust, symmetric_joints
from marey_motion.rigs.known import KNOWN_RIGS, KnownRig
from marey_motion.rigs.plain_names import readings
from marey_motion.skeleton import Skeleton

LIMBS = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
STANDARD_LIMBS = ("hip", "knee", "ankle", "toe", "clavicle", "shoulder", "elbow", "wrist")
# Pelvis, spine ×3, neck, head, the left limb joints in the order above, and how the left ones become right ones.
RIGS = {
    "mixamo": (
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head",
        "mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase "
        "mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
        ("Left", "Right"),
    ),
    "lafan1": (
        "Hips Spine Spine1 Spine2 Neck Head",
        "LeftUpLeg LeftLeg LeftFoot LeftToe LeftShoulder LeftArm LeftForeArm LeftHand",
        ("Left", "Right"),
    ),
    "hik": (
        "Hips Spine Spine1 Spine2 Neck Head",
        "LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftShoulder LeftArm LeftForeArm LeftHand",
        ("Left", "Right"),
    ),
    "unreal": (
        "pelvis spine_01 spine_02 spine_03 neck_01 head",
        "thigh_l calf_l foot_l ball_l clavicle_l upperarm_l lowerarm_l hand_l",
        ("_l", "_r"),
    ),
    "smpl": (
        "pelvis spine1 spine2 spine3 neck head",
        "left_hip left_knee left_ankle left_foot left_collar left_shoulder left_elbow left_wrist",
        ("left", "right"),
    ),
    "biped": (
        "Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
        "Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0 "
        "Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand",
        ("_L_", "_R_"),
    ),
    "rokoko": (
        "Hips Spine1 Spine2 Spine3 Neck Head",
        "LeftThigh LeftShin LeftFoot LeftToe LeftShoulder LeftArm LeftForeArm LeftHand",
        ("Left", "Right"),
    ),
    "xsens": (
        "Pelvis L5 T12 T8 Neck Head",
        "LeftUpperLeg LeftLowerLeg LeftFoot LeftToe LeftShoulder LeftUpperArm LeftForeArm LeftHand",
        ("Left", "Right"),
    ),
    "biovision": (
        "Hips Chest Spine2 Spine3 Neck Head",
        "LeftHip LeftKnee LeftAnkle LeftToe LeftCollar LeftShoulder LeftElbow LeftWrist",
        ("Left", "Right"),
    ),
    "daz": (
        "hip abdomen abdomen2 chest neck head",
        "lThigh lShin lFoot lToe lCollar lShldr lForeArm lHand",
        ("l", "r"),
    ),
    "optitrack": (
        "Hip Ab Ab2 Chest Neck Head",
        "LThigh LShin LFoot LToe LShoulder LUArm LFArm LHand",
        ("L", "R"),
    ),
    "vrm": (
        "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
        "J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase "
        "J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand",
        ("_L_", "_R_"),
    ),
    "rigify": (
        "spine spine.001 spine.002 spine.003 spine.004 spine.006",
        "thigh.L shin.L foot.L toe.L shoulder.L upper_arm.L forearm.L hand.L",
        (".L", ".R"),
    ),
}


def renamed(body: Skeleton, rig: tuple[str, str, tuple[str, str]]) -> tuple[Skeleton, dict[str, str]]:
    """Return the body with the names of another rig, and the expected name for each standard joint."""
    centre, of_left, (left, right) = rig
    limbs = of_left.split()
    names = dict(zip(("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"), centre.split(), strict=True))
    expected = dict(zip(("pelvis", "spine", "spine_1", "spine_2", "neck", "head"), centre.split(), strict=True))
    for side, word in (("Left", left), ("Right", right)):
        here = [name.replace(left, word, 1) for name in limbs]
        names |= dict(zip((side + limb for limb in LIMBS), here, strict=True))
        expected |= dict(zip((f"{side.lower()}_{limb}" for limb in STANDARD_LIMBS), here, strict=True))
    new = tuple(names[name] for name in body.joint_names)
    return replace(body, joint_names=new, display_names=new), expected


@pytest.mark.parametrize("rig", RIGS)
def test_a_known_rig_is_recognised_and_every_joint_gets_its_standard_name(body: Skeleton, rig: str) -> None:
    skeleton, expected = renamed(body, RIGS[rig])
    mapping = map_joints(skeleton)

    assert (mapping.rig, mapping.method, mapping.confidence, mapping.notes) == (rig, "names", 1.0, ())
    assert dict(mapping.joints) == {"root": expected["pelvis"]} | expected


def with_a_sword(skeleton: Skeleton, hand: int) -> Skeleton:
    """Return the skeleton with two more joints that hang from a hand and reach farther than the hand's fingers."""
    return replace(
        skeleton,
        joint_names=(*skeleton.joint_names, "grip", "blade"),
        display_names=(*skeleton.display_names, "grip", "blade"),
        parents=np.append(skeleton.parents, [hand, skeleton.joint_count]).astype(np.int32),
        offsets=np.append(skeleton.offsets, [[0, 0, 0.1], [0, 0, 0.9]], axis=0),
        rest_rotations=np.append(skeleton.rest_rotations, [[1, 0, 0, 0], [1, 0, 0, 0]], axis=0),
    )


EVERYDAY = {
    "unity": (
        "Hips Spine Chest UpperChest Neck Head",
        "LeftUpperLeg LeftLowerLeg LeftFoot LeftToes LeftShoulder LeftUpperArm LeftLowerArm LeftHand",
        ("Left", "Right"),
    ),
    "snake": (
        "hips spine chest upper_chest neck head",
        "left_upper_leg left_lower_leg left_foot left_toes left_shoulder left_upper_arm left_lower_arm left_hand",
        ("left", "right"),
    ),
    "blender": (
        "hips spine spine.001 chest neck head",
        "thigh.L shin.L foot.L toe.L shoulder.L upper_arm.L forearm.L hand.L",
        (".L", ".R"),
    ),
    "maya": (
        "hips_JNT spine_JNT spine1_JNT spine2_JNT neck_JNT head_JNT",
        "l_thigh_JNT l_leg_JNT l_foot_JNT l_toebase_JNT l_collar_JNT l_shldr_JNT l_forearm_JNT l_hand_JNT",
        ("l_", "r_"),
    ),
    "genesis": (
        "hip abdomenLower abdomenUpper chestLower neckLower head",
        "lThighBend lShin lFoot lToe lCollar lShldrBend lForearmBend lHand",
        ("l", "r"),
    ),
}


@pytest.mark.parametrize("style", EVERYDAY)
def test_everyday_words_name_a_body_of_no_known_rig_whatever_one_hand_holds(body: Skeleton, style: str) -> None:
    skeleton, expected = renamed(body, EVERYDAY[style])
    holding = with_a_sword(skeleton, skeleton.index_of(expected["right_wrist"]))
    for rig in (skeleton, holding):
        mapping = map_joints(rig)
        assert (mapping.rig, mapping.method, mapping.confidence) == (None, "names", 1.0)
        assert dict(mapping.joints) == {"root": expected["pelvis"]} | expected
        assert "everyday words" in " ".join(mapping.notes)


def test_a_build_that_shows_more_than_everyday_words_counts(body: Skeleton) -> None:
    skeleton, _ = renamed(body, EVERYDAY["snake"])
    names = tuple(name.replace("upper_leg", "leg_top") for name in skeleton.joint_names)
    mapping = map_joints(replace(skeleton, joint_names=names, display_names=names))

    assert mapping.method == "geometry"
    assert mapping.joints["left_hip"] == "left_leg_top"


def test_a_prefix_before_all_names_does_not_matter(body: Skeleton) -> None:
    names = tuple(f"Character1_{name}" for name in body.joint_names)
    mapping = map_joints(replace(body, joint_names=names, display_names=names))

    assert mapping.rig == "motionbuilder"
    assert mapping.joints["left_knee"] == "Character1_LeftLeg"


# What exporters, copies and scenes put on the name of every joint.
MARKS = {
    "copied in Blender": lambda name, joint: f"{name}.001",
    "copied, but the root": lambda name, joint: f"{name}.001" if joint else name,
    "copied twice": lambda name, joint: f"{name}_1.002",
    "numbered after": lambda name, joint: f"{name}_{joint:02d}",
    "numbered before": lambda name, joint: f"{joint}_{name}",
    "joined with a scene": lambda name, joint: f"Armature|hero:{name}",
    "of a modeller": lambda name, joint: f"{name}_jnt",
    "a modeller's, copied": lambda name, joint: f"{name}Joint.001",
    "of a figure called left": lambda name, joint: f"LeftHero_{name}",
}


def marked(skeleton: Skeleton, mark: Callable[..., Any]) -> Skeleton:
    names = tuple(mark(name, joint) for joint, name in enumerate(skeleton.joint_names))
    return replace(skeleton, joint_names=names, display_names=names)


def with_index_fingers(body: Skeleton) -> Skeleton:
    """Return the body with three joints of an index finger on each hand, named as in most rigs."""
    names, parents = list(body.joint_names), list(body.parents)
    for side in ("Left", "Right"):
        for level in (1, 2, 3):
            parents.append(names.index(f"{side}Hand" if level == 1 else f"{side}HandIndex{level - 1}"))
            names.append(f"{side}HandIndex{level}")
    offsets = np.concatenate((body.offsets, np.full((6, 3), 0.02)))
    return Skeleton(tuple(names), np.array(parents), offsets, quaternions.identity(len(names)))


@pytest.mark.parametrize("mark", MARKS.values(), ids=MARKS)
def test_a_mark_on_every_name_hides_neither_the_body_nor_its_fingers(body: Skeleton, mark: Callable[..., Any]) -> None:
    plain = with_index_fingers(body)
    known = map_joints(plain)
    skeleton = marked(plain, mark)
    mapping = map_joints(skeleton)

    assert known.joints["right_index_finger_tip"] == "RightHandIndex3"
    assert (mapping.rig, mapping.method, mapping.confidence) == (known.rig, "names", 1.0)
    assert {joint: skeleton.index_of(name) for joint, name in mapping.joints.items()} == {
        joint: plain.index_of(name) for joint, name in known.joints.items()
    }


@pytest.mark.parametrize("mark", MARKS.values(), ids=MARKS)
def test_a_mark_on_every_name_hides_no_real_rig(mocap: Path, mark: Callable[..., Any]) -> None:
    plain = read_skeleton(mocap / "rigs/misc/test_freebvh.bvh")
    known = map_joints(plain)
    skeleton = marked(plain, mark)

    assert len(known.joints) == 53
    assert [skeleton.index_of(name) for name in map_joints(skeleton).joints.values()] == [
        plain.index_of(name) for name in known.joints.values()
    ]


def test_numbers_that_tell_joints_apart_are_no_marks(body: Skeleton) -> None:
    names = tuple(f"bone_{joint}" for joint in range(body.joint_count))

    assert readings(names)[-1] == tuple(map(str, range(body.joint_count)))
    assert map_joints(replace(body, joint_names=names, display_names=names)).method == "geometry"


def test_a_mark_that_some_names_lack_is_part_of_the_others() -> None:
    names = ("Hips", "Spine", "Spine.001", "Head.001")

    assert readings(names) == (names,)


def test_a_body_without_telling_names_is_found_whatever_one_hand_holds(body: Skeleton) -> None:
    known = map_joints(body).joints
    names = tuple(f"bone{index}" for index in range(body.joint_count))
    anonymous = replace(body, joint_names=names, display_names=names)
    mapping = map_joints(with_a_sword(anonymous, body.index_of("RightHand")))

    assert mapping.method == "geometry"
    assert dict(mapping.joints) == {joint: names[body.index_of(name)] for joint, name in known.items()}


def anonymous(skeleton: Skeleton) -> Skeleton:
    names = tuple(f"bone{index}" for index in range(skeleton.joint_count))
    return replace(skeleton, joint_names=names, display_names=names)


def with_chains(skeleton: Skeleton, *chains: Any) -> Skeleton:
    """Return the skeleton with more joints: chains of (parent joint, offset, and the offsets of further joints)."""
    parents, offsets = list(skeleton.parents), [*skeleton.offsets]
    for parent, *bones in chains:
        for place, bone in enumerate(bones):
            parents.append(len(parents) - 1 if place else skeleton.index_of(parent))
            offsets.append(np.array(bone))
    names = (*skeleton.joint_names, *(f"more{joint}" for joint in range(len(parents) - skeleton.joint_count)))
    return Skeleton(names, np.array(parents), np.array(offsets), quaternions.identity(len(names)))


def with_twist_joints(skeleton: Skeleton, *names: Any) -> Skeleton:
    """Return the skeleton with one more joint in the middle of each bone that leads to these joints."""
    parents, offsets, order = list(skeleton.parents), [*skeleton.offsets], list(range(skeleton.joint_count))
    for name in names:
        joint = skeleton.index_of(name)
        offsets[joint] = offsets[joint] / 2
        order.insert(order.index(joint), len(parents))
        parents.append(parents[joint])
        offsets.append(offsets[joint])
        parents[joint] = len(parents) - 1
    place = {joint: at for at, joint in enumerate(order)}
    all_names = (*skeleton.joint_names, *(f"{name}Twist" for name in names))
    return Skeleton(
        tuple(all_names[joint] for joint in order),
        np.array([place.get(parents[joint], -1) for joint in order]),
        np.array([offsets[joint] for joint in order]),
        quaternions.identity(len(order)),
    )


def both(parent: str, first: tuple[Any, ...], *others: Any) -> list[Any]:
    """Return a chain on the left and its mirror image on the right."""
    return [(parent, *((side * x, y, z) for x, y, z in (first, *others))) for side in (1, -1)]


DRESSED = {
    "a cape": [("Spine2", (0, 0, -0.12), *[(0, -0.28, -0.05)] * 4)],
    "a cape of three": [("Spine2", (x, 0, -0.12), *[(0, -0.22, -0.05)] * 5) for x in (-0.1, 0, 0.1)],
    "short wings": both("Spine2", (0.08, 0.05, -0.1), *[(0.18, 0.05, -0.03)] * 4),
    "wings": both("Spine2", (0.08, 0.05, -0.1), *[(0.38, 0.1, -0.06)] * 4),
    "great wings": both("Spine2", (0.08, 0.05, -0.1), *[(0.6, 0.2, -0.1)] * 3),
    "a long appendix": [("Hips", (0, 0, -0.1), *[(0, -0.1, -0.15)] * 7)],
    "a pony tail": [("Head", (0, 0.08, -0.12), *[(0, -0.15, 0)] * 4)],
    "two plaits": both("Head", (0.08, 0.08, -0.05), *[(0, -0.2, 0)] * 4),
    "a skirt": [
        ("Hips", (0.15 * np.cos(a), 0, 0.15 * np.sin(a)), *[(0.03 * np.cos(a), -0.22, 0.03 * np.sin(a))] * 3)
        for a in np.arange(8) * np.pi / 4 + np.pi / 8
    ],
    "ears and pouches": [*both("Head", (0.07, 0.1, 0), *[(0, 0.06, 0)] * 3), *both("Hips", (0.2, 0, 0), (0, -0.1, 0))],
    "a sheath and a lance": [
        ("Hips", (0.15, 0, 0), (0, -0.3, -0.3), (0, -0.3, -0.3)),
        ("RightHand", (0, 0, 0.1), (0, 0, 0.6), (0, 0, 0.6)),
    ],
}


def assert_body_is_found(skeleton: Skeleton, body: Skeleton) -> None:
    mapping = map_joints(anonymous(skeleton))

    assert mapping.method == "geometry"
    found = {joint: skeleton.joint_names[int(name[4:])] for joint, name in mapping.joints.items()}
    known = {joint: name for joint, name in map_joints(body).joints.items() if joint in ESSENTIAL_JOINTS}
    assert {joint: found.get(joint) for joint in known} == known


@pytest.mark.parametrize("clothes", DRESSED.values(), ids=DRESSED)
def test_a_body_without_telling_names_is_found_in_all_kinds_of_clothes(body: Skeleton, clothes: list[Any]) -> None:
    assert_body_is_found(with_chains(body, *clothes), body)


@pytest.mark.parametrize(
    "bones",
    [("ForeArm", "Hand"), ("Leg", "Foot"), ("Hand",), ("ForeArm", "Hand", "Leg", "Foot")],
    ids=["arms", "legs", "forearms", "all"],
)
def test_twist_joints_are_not_taken_for_elbows_and_knees(body: Skeleton, bones: tuple[Any, ...]) -> None:
    twisted = with_twist_joints(body, *(f"{side}{bone}" for side in ("Left", "Right") for bone in bones))

    assert_body_is_found(twisted, body)


def test_arms_that_wings_may_be_as_well_are_doubted_in_words(body: Skeleton) -> None:
    arm = [body.offsets[body.index_of(f"Left{bone}")] for bone in ("Shoulder", "Arm", "ForeArm", "Hand")]
    mapping = map_joints(anonymous(with_chains(body, *both("Spine2", *map(tuple, arm)))))

    assert mapping.confidence < 0.3
    assert any("arms are doubtful: bone" in note for note in mapping.notes)
    with pytest.raises(MappingError, match="arms are doubtful"):
        require_trust(mapping)


def test_sides_that_no_foot_tells_are_said_to_be_a_guess(body: Skeleton) -> None:
    feet = [joint for joint, name in enumerate(body.joint_names) if "Toe" in name]
    kept = [joint for joint in range(body.joint_count) if joint not in feet]
    place = {joint: at for at, joint in enumerate(kept)}
    footless = Skeleton(
        tuple(f"bone{at}" for at in range(len(kept))),
        np.array([place.get(int(body.parents[joint]), -1) for joint in kept]),
        body.offsets[kept],
        quaternions.identity(len(kept)),
    )
    mapping = map_joints(footless)

    assert sum("are a guess: no foot shows" in note for note in mapping.notes) == 2
    assert mapping.confidence < map_joints(anonymous(body)).confidence


@pytest.mark.parametrize(("scale", "turn"), [(1.0, 0.0), (0.4, 2.0), (170.0, -1.0)])
def test_a_body_without_telling_names_is_found_by_its_build_whatever_its_size_and_direction(
    body: Skeleton, scale: float, turn: float
) -> None:
    known = map_joints(body).joints
    names = tuple(f"bone{index}" for index in range(body.joint_count))
    around = quaternions.from_axis_angle([0, 1, 0], turn)
    offsets = quaternions.rotate_vectors(around, body.offsets * scale).astype(np.float64)
    turned = [quaternions.rotate_vectors(around, site.offset * scale).astype(np.float64) for site in body.end_sites]
    sites = tuple(replace(site, offset=offset) for site, offset in zip(body.end_sites, turned, strict=True))
    skeleton = replace(body, joint_names=names, display_names=names, offsets=offsets, end_sites=sites)
    mapping = map_joints(skeleton)

    assert (mapping.rig, mapping.method) == (None, "geometry")
    assert mapping.confidence < 0.75
    assert {joint: skeleton.index_of(name) for joint, name in mapping.joints.items()} == {
        joint: body.index_of(name) for joint, name in known.items()
    }
    assert any("rest pose alone" in note for note in mapping.notes)


def test_sides_in_unknown_names_are_believed(body: Skeleton) -> None:
    names = tuple(
        f"{'R' if 'Right' in name else 'L' if 'Left' in name else 'C'}_b{i}x" for i, name in enumerate(body.joint_names)
    )
    mapping = map_joints(replace(body, joint_names=names, display_names=names))

    assert mapping.method == "geometry"
    assert mapping.joints["left_hip"].startswith("L_")
    assert not any("rest pose alone" in note for note in mapping.notes)


def test_half_a_body_says_what_it_lacks(body: Skeleton) -> None:
    legs = Skeleton(body.joint_names[:9], body.parents[:9], body.offsets[:9], body.rest_rotations[:9])
    mapping = map_joints(legs)

    assert mapping.joints["right_knee"] == "RightLeg"
    assert mapping.confidence == 0.5
    assert mapping.notes == (
        "not found: head, left_shoulder, left_elbow, left_wrist, right_shoulder, right_elbow, right_wrist",
    )


def test_what_is_no_body_is_said_to_be_none() -> None:
    snake = Skeleton(
        tuple(f"s{i}" for i in range(20)),
        np.arange(-1, 19, dtype=np.int32),
        np.full((20, 3), 0.1),
        quaternions.identity(20),
    )
    mapping = map_joints(snake)

    assert mapping.confidence == 0.0
    assert mapping.joints == {"root": "s0"}
    assert "does not look like a body" in mapping.notes[0]


def test_a_tail_costs_the_confidence_and_a_pony_tail_does_not(body: Skeleton) -> None:
    def with_tail(name: str, parent: str) -> Skeleton:
        return Skeleton(
            (*body.joint_names, name),
            np.append(body.parents, np.int32(body.index_of(parent))),
            np.concatenate((body.offsets, [[0, 0, -0.2]])),
            quaternions.identity(body.joint_count + 1),
        )

    animal = map_joints(with_tail("Tail1", "Hips"))
    assert animal.confidence <= 0.2
    assert "animal" in animal.notes[0]
    assert map_joints(with_tail("PonyTail", "Head")).confidence == 1.0


def test_a_body_that_rests_on_all_fours_is_doubted(body: Skeleton) -> None:
    offsets = body.offsets.copy()
    for joint, name in enumerate(body.joint_names):
        if "Spine" in name or name in ("Neck", "Head"):
            offsets[joint] = [0, 0, abs(offsets[joint]).max()]
        if "Arm" in name or "Hand" in name:
            offsets[joint] = [0, -abs(offsets[joint]).max(), 0]
    mapping = map_joints(replace(body, offsets=offsets))

    assert mapping.confidence <= 0.2
    assert "stands on arms and legs" in mapping.notes[0]


def test_the_plainer_of_two_names_is_the_joint(body: Skeleton) -> None:
    helpers = tuple(f"__{name}" for name in body.joint_names[1:])
    doubled = Skeleton(
        ("Hips", *(n for pair in zip(helpers, body.joint_names[1:], strict=True) for n in pair)),
        np.array([-1, *(p for i, q in enumerate(body.parents[1:]) for p in (2 * q, 2 * i + 1))]),
        np.concatenate([body.offsets[:1], *(np.stack((np.zeros(3), offset)) for offset in body.offsets[1:])]),
        quaternions.identity(2 * body.joint_count - 1),
    )
    assert map_joints(doubled).joints["left_hip"] == "LeftUpLeg"


def test_indices_of_standard_joints_and_the_ones_missing(body: Skeleton) -> None:
    mapping = map_joints(body)

    assert mapping.indices(body, ("left_hip", "head")) == (1, 21)
    with pytest.raises(MappingError, match="left_heel") as caught:
        mapping.indices(body, ("left_hip", "left_heel"))
    assert caught.value.where == "left_heel"


def test_the_partner_of_each_joint_is_across_the_body(body: Skeleton) -> None:
    partners = symmetric_joints(body, map_joints(body))
    names = [body.joint_names[partner] for partner in partners]

    assert names[body.index_of("LeftHand")] == "RightHand"
    assert names[body.index_of("RightFoot")] == "LeftFoot"
    assert names[body.index_of("Spine")] == "Spine"
    np.testing.assert_array_equal(partners[partners], np.arange(body.joint_count))


def test_standard_names_are_unique_and_mirror_onto_each_other() -> None:
    assert len(set(STANDARD_JOINTS)) == len(STANDARD_JOINTS)
    assert {mirrored(name) for name in STANDARD_JOINTS} == set(STANDARD_JOINTS)
    assert set(ESSENTIAL_JOINTS) <= set(STANDARD_JOINTS)
    assert mirrored("left_knee") == "right_knee"
    assert mirrored("pelvis") == "pelvis"


@pytest.mark.parametrize("rig", KNOWN_RIGS, ids=lambda rig: rig.name)
def test_dictionaries_speak_of_standard_joints_only_and_of_each_once(rig: KnownRig) -> None:
    joints = [joint for joint, _ in rig.names()]

    assert set(ESSENTIAL_JOINTS) <= set(joints) <= set(STANDARD_JOINTS)
    assert max(Counter(joints).values()) == 1
    if not rig.everyday:
        assert max(Counter(name for _, names in rig.names() for name in names).values()) == 1


def read_skeleton(path: Path) -> Skeleton:
    from marey_motion.formats import read_motion

    companion = next(path.parent.glob("*.asf")).read_bytes() if path.suffix == ".amc" else None
    return read_motion(path.read_bytes(), path.name, companion=companion).skeleton


# Pelvis, left hip, knee, ankle, toe, shoulder, elbow, wrist, and head; "-" where the rig has none.
REAL = {
    "bandai-namco-1/dataset-1_bow_active_001.bvh": (
        "bandai-namco",
        "Hips UpperLeg_L LowerLeg_L Foot_L Toes_L UpperArm_L LowerArm_L Hand_L Head",
    ),
    "bandai-namco-2/dataset-2_raise-up-right-hand_active_001.bvh": (
        "bandai-namco",
        "Hips UpperLeg_L LowerLeg_L Foot_L Toes_L UpperArm_L LowerArm_L Hand_L Head",
    ),
    "cmu-amc/02/02_01.amc": ("cmu-asf", "root lfemur ltibia lfoot ltoes lhumerus lradius lwrist head"),
    "cmu-bvh/01_01.bvh": (
        "cmu-bvh",
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftArm LeftForeArm LeftHand Head",
    ),
    "cmu-iclone-bvh/002_01.bvh": (
        "reallusion",
        "CC_Base_Hip CC_Base_L_Thigh CC_Base_L_Calf CC_Base_L_Foot CC_Base_L_ToeBase "
        "CC_Base_L_Upperarm CC_Base_L_Forearm CC_Base_L_Hand CC_Base_Head",
    ),
    "rigs/misc/test_freebvh.bvh": (
        "mixamo",
        "mixamorig:Hips mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase "
        "mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand mixamorig:Head",
    ),
    "rigs/misc/test_mocapbank.bvh": (
        "biovision",
        "Hips LeftHip LeftKnee LeftAnkle - LeftShoulder LeftElbow LeftWrist Head",
    ),
    "rigs/misc/walk01.bvh": ("hik", "Hips LeftUpLeg LeftLeg LeftFoot - LeftArm LeftForeArm LeftHand Head"),
    "rigs/game-engine/custom_skeleton_walk_example.bvh": (
        "game-engine",
        "FK_back1_jnt L_upLeg_jnt L_lowLeg_jnt L_foot_jnt L_toe_jnt L_upArm_jnt L_lowArm_jnt L_hand_jnt head_jnt",
    ),
    "rigs/game-engine/mh_cmu_skeleton_pose.bvh": (
        "mh-cmu",
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftArm LeftForeArm LeftHand Head",
    ),
    "rigs/makehuman/walk1.bvh": ("makehuman-1", "Root UpLeg_L LoLeg_L Foot_L Toe_L UpArm_L LoArm_L Hand_L Head"),
    "rigs/makehuman/tpose.bvh": (
        "makehuman",
        "root upperleg01.L lowerleg01.L foot.L toe1-1.L upperarm01.L lowerarm01.L wrist.L head",
    ),
    "rigs/geno/Geno_stance.bvh": (
        "geno",
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftArm LeftForeArm LeftHand Head",
    ),
    "rigs/snu-mass/walk.bvh": (
        "motionbuilder",
        "Character1_Hips Character1_LeftUpLeg Character1_LeftLeg Character1_LeftFoot Character1_LeftToeBase "
        "Character1_LeftArm Character1_LeftForeArm Character1_LeftHand Character1_Head",
    ),
    "rigs/snu-mss/walk.bvh": (
        "motionbuilder",
        "Character1_Hips Character1_LeftUpLeg Character1_LeftLeg Character1_LeftFoot Character1_LeftToeBase "
        "Character1_LeftArm Character1_LeftForeArm Character1_LeftHand Character1_Head",
    ),
    "torture/pybvh-bvh_test2.bvh": (
        "xsens-bvh",
        "Hips LeftHip LeftKnee LeftAnkle LeftToe LeftShoulder LeftElbow LeftWrist Head",
    ),
}
JOINTS = ("pelvis", *(f"left_{j}" for j in ("hip", "knee", "ankle", "toe", "shoulder", "elbow", "wrist")), "head")
SWAPS = (("Left", "Right"), ("_L", "_R"), (".L", ".R"), ("L_", "R_"))


def right_of(name: str) -> str:
    for left, right in SWAPS:
        if left in name:
            return name.replace(left, right)
    return "r" + name[1:]


@pytest.mark.parametrize("file", REAL)
def test_real_rigs_are_mapped_as_a_person_would(mocap: Path, file: str) -> None:
    rig, names = REAL[file]
    mapping = map_joints(read_skeleton(mocap / file))

    assert (mapping.rig, mapping.confidence) == (rig, 1.0)
    for joint, name in zip(JOINTS, names.split(), strict=True):
        assert mapping.joints.get(joint, "-") == name
        if joint.startswith("left_") and name != "-":
            assert mapping.joints[mirrored(joint)] == right_of(name)


# Left and right of the one, and the joints among the twist bones of the other, cannot be told without names.
UNTELLABLE = ("rigs/game-engine/custom_skeleton_walk_example.bvh", "rigs/makehuman/tpose.bvh")


@pytest.mark.parametrize("file", [file for file in REAL if file not in UNTELLABLE])
def test_real_rigs_without_their_names_are_found_by_build(mocap: Path, file: str) -> None:
    skeleton = read_skeleton(mocap / file)
    known = map_joints(skeleton)
    names = tuple(f"bone{index}" for index in range(skeleton.joint_count))
    mapping = map_joints(replace(skeleton, joint_names=names, display_names=names))

    assert mapping.method == "geometry"
    for joint in JOINTS:
        if joint in known.joints:
            assert mapping.joints[joint] == names[skeleton.index_of(known.joints[joint])]


@pytest.mark.parametrize("file", ["dog_run.bvh", "dog_walk.bvh"])
def test_a_dog_is_not_passed_off_as_a_person(mocap: Path, file: str) -> None:
    mapping = map_joints(read_skeleton(mocap / "rigs" / "quadruped" / file))

    assert mapping.rig is None
    assert mapping.confidence <= 0.2
    assert any("animal" in note for note in mapping.notes)


def test_a_rig_of_many_limbs_on_a_chain_of_a_thousand_joints_is_read_soon(body: Skeleton) -> None:
    links = 1000
    many = with_chains(
        body, *((joint, *[(0.1 + 0.01 * k, 0.02, 0)] * 13) for joint in ("Hips", "Spine2") for k in range(12))
    )
    parents = np.concatenate((np.arange(-1, links - 1, dtype=np.int32), many.parents + np.int32(links)))
    parents[links] = links - 1
    offsets = np.concatenate((np.full((links, 3), 0.001), many.offsets))
    names = tuple(f"bone{joint}" for joint in range(len(parents)))
    started = process_time()
    mapping = map_joints(Skeleton(names, parents, offsets, quaternions.identity(len(parents))))

    assert process_time() - started < 5.0
    assert mapping.method == "geometry"


def test_a_clavicle_without_length_is_no_clavicle() -> None:
    skeleton = studio_skeleton()
    offsets = skeleton.offsets.copy()
    offsets[skeleton.index_of("LeftArm")] = 0.0
    bare = Skeleton(skeleton.joint_names, skeleton.parents, offsets, skeleton.rest_rotations, skeleton.end_sites)
    joints = map_joints(bare).joints
    assert joints["left_shoulder"] == "LeftArm"
    assert "left_clavicle" not in joints
    assert joints["right_clavicle"] == "RightShoulder"


def test_what_documents_call_doubtful_is_refused() -> None:
    mapping = map_joints(studio_skeleton())
    assert require_trust(replace(mapping, confidence=0.5)).confidence == 0.5
    with pytest.raises(MappingError, match=r"confidence of 0\.49 only.*--confirm"):
        require_trust(replace(mapping, confidence=0.49))
