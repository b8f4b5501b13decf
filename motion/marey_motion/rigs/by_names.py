"""Recognition of a rig by the names of its joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from marey_motion.rigs.known import KNOWN_RIGS, KnownRig
from marey_motion.rigs.names import JointName, parse_name
from marey_motion.rigs.plain_names import Names, readings
from marey_motion.rigs.standard import CHAINS, ESSENTIAL_JOINTS
from marey_motion.skeleton import Skeleton

# Common prefixes that are tried; a file has one, and a few joints may look as if they had others.
MOST_PREFIXES = 8


@dataclass(frozen=True)
class NameMatch:
    """The joints of a skeleton that have the names of a known rig.

    Parameters
    ----------
    rig : str, optional    name of the rig; None if the names are everyday words that belong to no particular tool
    joints : dict of str to int    index by standard name
    signature_share : float    share of the rig's distinctive names (`KnownRig.signature`) that were found, 0 to 1
    """

    rig: str | None
    joints: dict[str, int]
    signature_share: float

    @property
    def essential_count(self) -> int:
        """Number of essential joints found."""
        return sum(joint in self.joints for joint in ESSENTIAL_JOINTS)

    @property
    def essential_share(self) -> float:
        """Share of the essential joints found, 0 to 1."""
        return self.essential_count / len(ESSENTIAL_JOINTS)

    @property
    def rank(self) -> tuple[float, bool, float, int]:
        """Sort key; better matches have greater ranks."""
        return self.essential_share, self.rig is not None, self.signature_share, len(self.joints)


def best_match(skeleton: Skeleton) -> NameMatch | None:
    """Find the known rig whose names fit best.

    If several rigs match equally many essential joints, the rig of a tool is preferred to everyday words. If rigs match
    equally well in every respect, the rig listed first is taken.

    Parameters
    ----------
    skeleton : Skeleton    skeleton whose display names are compared

    Returns
    -------
    NameMatch or None    None when no rig's pelvis is found
    """
    matches = [
        match
        for names in readings(skeleton.display_names)
        for joints in (_by_name(names),)
        for rig in KNOWN_RIGS
        for match in _matches(rig, names, joints, skeleton)
    ]
    return max(matches, key=lambda match: match.rank, default=None)


def _by_name(names: Names) -> dict[JointName, int]:
    """Index joints by parsed name; if parsed names are equal, as for UpLeg_L and __UpLeg_L, the shorter name wins."""
    joints: dict[JointName, int] = {}
    for index in sorted(range(len(names)), key=lambda joint: len(names[joint])):
        joints.setdefault(parse_name(names[index]), index)
    return joints


def _matches(rig: KnownRig, names: Names, joints: dict[JointName, int], skeleton: Skeleton) -> Iterator[NameMatch]:
    templates = _parsed_names(rig)
    for prefix in _prefixes(dict(templates)["pelvis"], joints):
        signature = _signature_share(rig, prefix, names, joints)
        if rig.signature and signature <= 0.5:
            continue
        found = {
            standard: index
            for standard, alternatives in templates
            if (index := _first(alternatives, prefix, joints)) is not None
        }
        _drop_misplaced(found, skeleton)
        yield NameMatch(None if rig.everyday else rig.name, found, signature)


@cache
def _parsed_names(rig: KnownRig) -> tuple[tuple[str, tuple[JointName, ...]], ...]:
    return tuple((standard, tuple(map(parse_name, alternatives))) for standard, alternatives in rig.names())


def _prefixes(pelvis: tuple[JointName, ...], joints: dict[JointName, int]) -> list[str]:
    """List prefixes that all joint names may share, the shortest first.

    If a joint name ends with the rig's name for the pelvis, the text before this ending may be a prefix.
    """
    prefixes = {
        joint.base[: len(joint.base) - len(name.base)]
        for name in pelvis
        for joint in joints
        if joint.side == name.side and joint.base.endswith(name.base)
    }
    return sorted(prefixes, key=lambda prefix: (len(prefix), prefix))[:MOST_PREFIXES]


def _first(alternatives: tuple[JointName, ...], prefix: str, joints: dict[JointName, int]) -> int | None:
    for name in alternatives:
        index = joints.get(JointName(name.side, prefix + name.base))
        if index is not None:
            return index
    return None


def _signature_share(rig: KnownRig, prefix: str, names: Names, joints: dict[JointName, int]) -> float:
    """Compute the share of a rig's distinctive names that the skeleton has; 0 for rigs without such names."""
    there = 0
    for mark in rig.signature:
        if mark.endswith("*"):
            begun = sum(name.lower().startswith(mark[:-1]) for name in names)
            there += 2 * begun > len(names)
        else:
            there += _first((parse_name(mark),), prefix, joints) is not None
    return there / max(1, len(rig.signature))


def _drop_misplaced(found: dict[str, int], skeleton: Skeleton) -> None:
    """Remove joints that do not descend from the joint that should be above them."""
    for chain in CHAINS:
        above: int | None = None
        for standard in chain:
            index = found.get(standard)
            if index is None:
                continue
            if above is not None and (index == above or above not in skeleton.path_to_root(index)):
                del found[standard]
            else:
                above = index
