"""Rigs that are in common use, with the names of their joints.

Names are given as templates, in which "{}" marks the position of the side. Names are compared by side and base (see the
module `names`), so one template covers all styles of writing a name. Prefixes that all joints of a file share are not
part of a template.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from marey_motion.rigs.standard import FINGERS, SIDES

Names = str | tuple[str, ...]


@dataclass(frozen=True, eq=False)
class KnownRig:
    """Names of one rig's joints; if a joint has several alternative names, the first that is found is used.

    Several rigs use the same names for the joints of the body; `signature` distinguishes these rigs. It lists names of
    further joints, or a prefix of most names, written "prefix*". More than half of the signature must be found.

    `everyday` is true if the names are everyday words and belong to no particular tool. Such names are chosen only if
    they match more essential joints than the names of any tool.
    """

    name: str
    pelvis: Names = "Hips"
    neck: Names = "Neck"
    head: Names = "Head"
    clavicle: Names = "{}Shoulder"
    shoulder: Names = "{}Arm"
    elbow: Names = "{}ForeArm"
    wrist: Names = "{}Hand"
    hip: Names = "{}UpLeg"
    knee: Names = "{}Leg"
    ankle: Names = "{}Foot"
    toe: Names = "{}ToeBase"
    extremities: Mapping[str, Names] = field(default_factory=dict)
    signature: tuple[str, ...] = ()
    side_words: tuple[str, str] = ("Left", "Right")
    everyday: bool = False

    def names(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """List each standard joint with its possible names.

        Yields
        ------
        standard, names : str, tuple of str    a standard joint and its names, the preferred first
        """
        for joint in ("pelvis", "neck", "head"):
            yield joint, _alternatives(getattr(self, joint))
        for side, word in zip(SIDES, self.side_words, strict=True):
            for joint in ("clavicle", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe"):
                yield f"{side}_{joint}", tuple(name.format(word) for name in _alternatives(getattr(self, joint)))
            for joint, names in self.extremities.items():
                yield f"{side}_{joint}", tuple(name.format(word) for name in _alternatives(names))


def _alternatives(names: Names) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names


def _fingers(pattern: str, fingers: tuple[str, ...], levels: tuple[str, ...]) -> dict[str, Names]:
    """Build templates for the joints of thumb and fingers.

    In `pattern`, <finger> is replaced by each of `fingers`, the rig's names of the fingers, thumb first. <level> is
    replaced by each of `levels`, the rig's names of base, mid, tip and end of a finger; the last ones may be omitted.
    """
    named = zip(("thumb", *(f"{finger}_finger" for finger in FINGERS)), fingers, strict=True)
    return {
        f"{standard}_{part}": pattern.replace("<finger>", finger).replace("<level>", level)
        for standard, finger in named
        for part, level in zip(("base", "mid", "tip", "end"), levels, strict=False)
    }


def _finger_roots(pattern: str, fingers: tuple[str, ...]) -> dict[str, Names]:
    named = zip(FINGERS, fingers, strict=True)
    return {f"{standard}_finger_root": pattern.replace("<finger>", finger) for standard, finger in named}


def _everyday_fingers() -> dict[str, Names]:
    """Build templates for the names of finger joints, from everyday words for fingers such as "Index".

    A word is followed by a number (Index1, HandIndex1, Index01), or by the name of a bone, as in Unity and VRM
    (IndexProximal). In each template, "{}" represents the side of the body.
    """
    bones = {"base": ("1", "Proximal"), "mid": ("2", "Intermediate", "Medial"), "tip": ("3", "Distal")}
    thumb = {"base": ("1", "Metacarpal", "Proximal"), "mid": ("2", "Intermediate"), "tip": ("3", "Distal")}
    words = {
        "thumb": ("Thumb",),
        "index_finger": ("Index",),
        "middle_finger": ("Middle", "Mid"),
        "ring_finger": ("Ring",),
        "pinky_finger": ("Pinky", "Little"),
    }
    styles = ("{}<word><bone>", "{}Hand<word><bone>", "{}<word>0<bone>")
    return {
        f"{standard}_{part}": tuple(
            style.replace("<word>", word).replace("<bone>", bone)
            for bone in alternatives
            for word in names
            for style in styles
        )
        for standard, names in words.items()
        for part, alternatives in (thumb if standard == "thumb" else bones).items()
    }


_FIVE = ("Thumb", "Index", "Middle", "Ring", "Pinky")
_HIK_HAND = _fingers("{}Hand<finger><level>", _FIVE, ("1", "2", "3", "4")) | {
    **_finger_roots("{}InHand<finger>", _FIVE[1:]),
    "heel": "{}Heel",
}

_HIK = KnownRig("hik", extremities=_HIK_HAND, toe=("{}ToeBase", "{}Toe", "{}ForeFoot"))
_CMU_BVH = replace(_HIK, extremities=_HIK_HAND | {"finger": "{}FingerBase", "thumb_base": ("{}Thumb", "{}HandThumb1")})
_BIOVISION = KnownRig(
    "biovision",
    clavicle="{}Collar",
    shoulder="{}Shoulder",
    elbow="{}Elbow",
    wrist="{}Wrist",
    hip="{}Hip",
    knee="{}Knee",
    ankle="{}Ankle",
    toe=("{}Toe", "{}Toes"),
)

KNOWN_RIGS: tuple[KnownRig, ...] = (
    replace(_HIK, name="mixamo", signature=("mixamorig*",)),
    replace(_HIK, name="motionbuilder", signature=("character*",)),
    replace(_HIK, name="perception-neuron", signature=("LeftInHandIndex", "RightInHandIndex")),
    replace(_HIK, name="captury", signature=("Spine3", "Spine4")),
    replace(_HIK, name="geno", signature=("Spine3", "Neck1", "LeftHandThumb4", "LeftToeBaseEnd")),
    replace(_HIK, name="lafan1", toe="{}Toe", extremities={}, signature=("LeftToe", "RightToe")),
    replace(_CMU_BVH, name="cmu-bvh", signature=("LHipJoint", "LowerBack", "LFingers", "LThumb", "Neck1")),
    replace(_CMU_BVH, name="mh-cmu", signature=("LHipJoint", "LowerBack", "LeftHandFinger1", "LThumb", "Neck1")),
    _HIK,
    KnownRig(
        "cmu-asf",
        pelvis="root",
        neck="lowerneck",
        head="head",
        clavicle="{}clavicle",
        shoulder="{}humerus",
        elbow="{}radius",
        wrist=("{}wrist", "{}hand"),
        hip="{}femur",
        knee="{}tibia",
        ankle="{}foot",
        toe="{}toes",
        extremities={"finger": "{}fingers", "thumb_base": "{}thumb"},
        side_words=("l", "r"),
    ),
    KnownRig(
        "bandai-namco",
        shoulder="{}UpperArm",
        elbow="{}LowerArm",
        hip="{}UpperLeg",
        knee="{}LowerLeg",
        toe="{}Toes",
        signature=("joint_Root", "Chest"),
    ),
    KnownRig(
        "xsens",
        pelvis="Pelvis",
        shoulder="{}UpperArm",
        hip="{}UpperLeg",
        knee="{}LowerLeg",
        toe="{}Toe",
        signature=("L5", "L3", "T12", "T8"),
    ),
    replace(_BIOVISION, name="xsens-bvh", signature=("Chest2", "Chest3", "Chest4")),
    _BIOVISION,
    KnownRig(
        "rokoko",
        pelvis=("Hips", "Hip"),
        hip="{}Thigh",
        knee="{}Shin",
        toe=("{}Toe", "{}ToeBase"),
        extremities={
            "thumb_base": "{}Finger1Metacarpal",
            "thumb_mid": "{}Finger1Proximal",
            "thumb_tip": "{}Finger1Distal",
            **{
                f"{finger}_finger_{part}": f"{{}}Finger{number}{bone}"
                for number, finger in enumerate(FINGERS, start=2)
                for part, bone in (("root", "Metacarpal"), ("base", "Proximal"), ("mid", "Medial"), ("tip", "Distal"))
            },
        },
    ),
    KnownRig(
        "smpl",
        pelvis="pelvis",
        clavicle="{}_collar",
        shoulder="{}_shoulder",
        elbow="{}_elbow",
        wrist="{}_wrist",
        hip="{}_hip",
        knee="{}_knee",
        ankle="{}_ankle",
        toe=("{}_foot", "{}_toe"),
        extremities=_fingers("{}_<finger><level>", _FIVE, ("1", "2", "3")) | {"finger": "{}_hand"},
    ),
    KnownRig(
        "unreal",
        pelvis="pelvis",
        neck="neck_01",
        clavicle="clavicle_{}",
        shoulder="upperarm_{}",
        elbow="lowerarm_{}",
        wrist="hand_{}",
        hip="thigh_{}",
        knee="calf_{}",
        ankle="foot_{}",
        toe="ball_{}",
        extremities=_fingers("<finger>_<level>_{}", _FIVE, ("01", "02", "03"))
        | _finger_roots("<finger>_metacarpal_{}", _FIVE[1:])
        | {"heel": "heel_{}"},
        signature=("spine_01",),
    ),
    KnownRig(
        "biped",
        pelvis="Pelvis",
        clavicle="{} Clavicle",
        shoulder="{} UpperArm",
        elbow="{} Forearm",
        wrist="{} Hand",
        hip="{} Thigh",
        knee="{} Calf",
        ankle="{} Foot",
        toe="{} Toe0",
        extremities=_fingers("{} Finger<finger><level>", ("0", "1", "2", "3", "4"), ("", "1", "2", "Nub")),
        signature=("bip*",),
    ),
    KnownRig(
        "reallusion",
        pelvis="Hip",
        neck=("NeckTwist01", "Neck"),
        clavicle="{}_Clavicle",
        shoulder="{}_Upperarm",
        elbow="{}_Forearm",
        wrist="{}_Hand",
        hip="{}_Thigh",
        knee="{}_Calf",
        ankle="{}_Foot",
        toe="{}_ToeBase",
        extremities=_fingers("{}_<finger><level>", ("Thumb", "Index", "Mid", "Ring", "Pinky"), ("1", "2", "3")),
        signature=("cc_base*",),
    ),
    KnownRig(
        "makehuman",
        pelvis="root",
        neck="neck01",
        head="head",
        clavicle="clavicle.{}",
        shoulder="upperarm01.{}",
        elbow="lowerarm01.{}",
        wrist="wrist.{}",
        hip="upperleg01.{}",
        knee="lowerleg01.{}",
        ankle="foot.{}",
        toe="toe1-1.{}",
        extremities=_fingers("finger<finger>-<level>.{}", ("1", "2", "3", "4", "5"), ("1", "2", "3"))
        | _finger_roots("metacarpal<finger>.{}", ("1", "2", "3", "4")),
        signature=("spine05", "pelvis.L"),
    ),
    KnownRig(
        "makehuman-1",
        pelvis="Root",
        clavicle="Clavicle_{}",
        shoulder="UpArm_{}",
        elbow="LoArm_{}",
        wrist="Hand_{}",
        hip="UpLeg_{}",
        knee="LoLeg_{}",
        ankle="Foot_{}",
        toe="Toe_{}",
        extremities=_fingers("<finger><level>_{}", _FIVE, ("1", "2", "3")),
    ),
    KnownRig(
        "game-engine",
        pelvis="FK_back1_jnt",
        neck="FK_back4_jnt",
        head="head_jnt",
        clavicle="{}_shoulder_jnt",
        shoulder="{}_upArm_jnt",
        elbow="{}_lowArm_jnt",
        wrist="{}_hand_jnt",
        hip="{}_upLeg_jnt",
        knee="{}_lowLeg_jnt",
        ankle="{}_foot_jnt",
        toe="{}_toe_jnt",
        extremities={"finger": "{}_hand_end_jnt"}
        | _fingers("{}_<finger>_<level>_jnt", tuple(name.lower() for name in _FIVE), ("base", "mid", "tip", "end"))
        | _finger_roots("{}_<finger>_root_jnt", FINGERS),
    ),
    KnownRig(
        "daz",
        pelvis="hip",
        neck="neck",
        head="head",
        clavicle="{}Collar",
        shoulder="{}Shldr",
        elbow="{}ForeArm",
        wrist="{}Hand",
        hip="{}Thigh",
        knee="{}Shin",
        ankle="{}Foot",
        toe="{}Toe",
        extremities=_fingers("{}<finger><level>", ("Thumb", "Index", "Mid", "Ring", "Pinky"), ("1", "2", "3")),
        side_words=("l", "r"),
        signature=("abdomen",),
    ),
    KnownRig(
        "optitrack",
        pelvis="Hip",
        shoulder="{}UArm",
        elbow="{}FArm",
        hip="{}Thigh",
        knee="{}Shin",
        toe="{}Toe",
        extremities=_fingers("{}<finger><level>", _FIVE, ("1", "2", "3")),
        side_words=("L", "R"),
    ),
    KnownRig(
        "vrm",
        pelvis="J_Bip_C_Hips",
        neck="J_Bip_C_Neck",
        head="J_Bip_C_Head",
        clavicle="J_Bip_{}_Shoulder",
        shoulder="J_Bip_{}_UpperArm",
        elbow="J_Bip_{}_LowerArm",
        wrist="J_Bip_{}_Hand",
        hip="J_Bip_{}_UpperLeg",
        knee="J_Bip_{}_LowerLeg",
        ankle="J_Bip_{}_Foot",
        toe="J_Bip_{}_ToeBase",
        extremities=_fingers(
            "J_Bip_{}_<finger><level>", ("Thumb", "Index", "Middle", "Ring", "Little"), ("1", "2", "3")
        ),
    ),
    KnownRig(
        "rigify",
        pelvis="spine",
        neck="spine.004",
        head="spine.006",
        clavicle="shoulder.{}",
        shoulder="upper_arm.{}",
        elbow="forearm.{}",
        wrist="hand.{}",
        hip="thigh.{}",
        knee="shin.{}",
        ankle="foot.{}",
        toe="toe.{}",
        extremities={"heel": "heel.02.{}"},
        signature=("spine.001",),
    ),
    KnownRig(
        "everyday words",
        pelvis=("Hips", "Hip", "Pelvis"),
        neck=("Neck", "LowerNeck", "NeckLower", "Neck1", "Neck01"),
        clavicle=("{}Clavicle", "{}Collar", "{}CollarBone", "{}Shoulder"),
        shoulder=("{}UpperArm", "{}UpArm", "{}UArm", "{}ShldrBend", "{}Shldr", "{}Humerus", "{}Arm"),
        elbow=("{}LowerArm", "{}ForeArm", "{}LoArm", "{}LowArm", "{}LArm", "{}FArm", "{}ForearmBend", "{}Elbow"),
        wrist=("{}Wrist", "{}Hand"),
        hip=("{}UpperLeg", "{}Thigh", "{}UpLeg", "{}ThighBend", "{}Hip"),
        knee=("{}LowerLeg", "{}LoLeg", "{}LowLeg", "{}Shin", "{}Calf", "{}Shank", "{}Knee", "{}Leg"),
        ankle=("{}Ankle", "{}Foot"),
        toe=("{}ToeBase", "{}Toes", "{}Toe", "{}Ball", "{}ForeFoot", "{}Foot"),
        extremities=_everyday_fingers(),
        everyday=True,
    ),
)
