"""Names of joints in any style are parsed to the same side and part of the body."""

import pytest

from marey_motion.rigs.names import parse_name


@pytest.mark.parametrize(
    "name",
    [
        "LeftUpLeg",
        "leftUpLeg",
        "L_UpLeg",
        "l_upLeg",
        "UpLeg_L",
        "UpLeg.L",
        "upLeg l",
        "mixamorig:LeftUpLeg",
        "a|b:LUpLeg",
    ],
)
def test_every_style_of_a_left_thigh_is_one_name(name: str) -> None:
    assert parse_name(name) == ("left", "upleg")


@pytest.mark.parametrize(
    ("name", "side", "base"),
    [
        ("CC_Base_R_Thigh", "right", "ccbasethigh"),
        ("Bip01 L Thigh", "left", "bip01thigh"),
        ("Character1_RightToeBase", "right", "character1toebase"),
        ("lhumerus", "", "lhumerus"),
        ("LHipJoint", "left", "hipjoint"),
        ("FootR", "right", "foot"),
        ("rShldr", "right", "shldr"),
        ("thigh_l", "left", "thigh"),
        ("lefthand", "left", "hand"),
        ("CHARACTER1_LEFTHANDINDEX1", "left", "character1handindex1"),
        ("finger1-2.L", "left", "finger12"),
        ("L5", "", "l5"),
        ("Left", "", "left"),
        ("Hips", "", "hips"),
        ("骨盆", "", ""),
        ("", "", ""),
    ],
)
def test_sides_are_read_where_they_are_and_nowhere_else(name: str, side: str, base: str) -> None:
    assert parse_name(name) == (side, base)
