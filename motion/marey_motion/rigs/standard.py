"""Standard joints: the essential joints of a body, the chains that the joints form, and pairs of left and right."""

from __future__ import annotations

from marey_schemas.documents.standard_joints import CENTRE_JOINTS, FINGERS, SIDES, STANDARD_JOINTS

__all__ = [
    "CENTRE_JOINTS",
    "CHAINS",
    "ESSENTIAL_JOINTS",
    "FINGERS",
    "SIDES",
    "STANDARD_JOINTS",
    "mirrored",
    "split_side",
]

# Without these a body cannot be read or retargeted as a human's.
ESSENTIAL_JOINTS = (
    "pelvis",
    "head",
    *(f"{side}_{joint}" for side in SIDES for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")),
)

# Chains along which each standard joint must be a descendant of the one before it.
CHAINS = (
    ("pelvis", "spine", "spine_1", "spine_2"),
    ("pelvis", "neck", "head"),
    *(tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "toe")) for side in SIDES),
    *(tuple(f"{side}_{joint}" for joint in ("clavicle", "shoulder", "elbow", "wrist")) for side in SIDES),
)


def split_side(standard: str) -> tuple[str, str]:
    """Split the name of a standard joint into its side and the rest.

    Parameters
    ----------
    standard : str    standard name

    Returns
    -------
    side : str    "left" or "right"; empty for joints of the centre
    joint : str    name without the side, such as "knee"; for joints of the centre, the whole name
    """
    side, _, joint = standard.partition("_")
    return (side, joint) if side in SIDES else ("", standard)


def mirrored(name: str) -> str:
    """Return the name of the standard joint on the other side of the body.

    Parameters
    ----------
    name : str    standard name

    Returns
    -------
    str    standard name; joints of the centre keep their names
    """
    for side, other in (SIDES, SIDES[::-1]):
        if name.startswith(f"{side}_"):
            return other + name[len(side) :]
    return name
