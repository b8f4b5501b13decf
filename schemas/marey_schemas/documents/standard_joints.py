"""Names of the standard joints: one name for the same anatomical joint of every rig.

A joint is named for the articulation at its origin: `left_hip` is where the left thigh turns, and `left_shoulder` is
where the left upper arm turns (rigs often call this joint "arm", and the clavicle "shoulder").
"""

from __future__ import annotations

SIDES = ("left", "right")
FINGERS = ("index", "middle", "ring", "pinky")

CENTRE_JOINTS = ("root", "pelvis", "spine", "spine_1", "spine_2", "neck", "head")
SIDE_JOINTS = (
    "clavicle",
    "shoulder",
    "elbow",
    "wrist",
    "finger",
    "hip",
    "knee",
    "ankle",
    "toe",
    "heel",
    "hold_point",
    *(f"thumb_{part}" for part in ("base", "mid", "tip", "end")),
    *(f"{finger}_finger_{part}" for finger in FINGERS for part in ("root", "base", "mid", "tip", "end")),
)
LIMB_ENDS = ("left_wrist", "right_wrist", "left_ankle", "right_ankle")
"""Wrists and ankles, whose positions stand for those of hands and feet, because nearly every skeleton has them."""
STANDARD_JOINTS = (*CENTRE_JOINTS, *(f"{side}_{joint}" for side in SIDES for joint in SIDE_JOINTS))
