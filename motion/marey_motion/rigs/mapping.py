"""Standard names for a skeleton's joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MappingError
from marey_motion.rigs import by_geometry, by_names
from marey_motion.rigs.names import parse_name
from marey_motion.rigs.standard import ESSENTIAL_JOINTS, SIDES, STANDARD_JOINTS, mirrored
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.skeletons import MappingMethod

# If the names cover a smaller share of the essential joints, they are compared with the geometry.
TRUSTED_SHARE = 0.75
# Confidence of a mapping of a skeleton that seems to have four legs.
ANIMAL_CONFIDENCE = 0.2
# A mapping with a lower confidence must be checked by a person before it is used.
LEAST_CONFIDENCE = 0.5
# A clavicle shorter than this share of the upper arm is a joint without a bone.
_SHORTEST_CLAVICLE = 1e-3
_ANIMAL_NOTE = "hind and front legs were taken for legs and arms, check before use"
_ANIMAL_WORDS = ("tail", "paw", "hoof", "hock", "fetlock", "snout", "muzzle")


@dataclass(frozen=True)
class JointMapping:
    """The joints of a skeleton by standard name.

    Parameters
    ----------
    rig : str, optional    the known rig whose names were recognised
    joints : mapping of str to str    standard name to joint name; one joint can have several standard names, such as
        hips that are both root and pelvis
    confidence : float    0 to 1; below `LEAST_CONFIDENCE`, a person must check the mapping before use
    method : str    "names", "geometry" or "manual"
    notes : tuple of str    assumptions and missing joints, in sentences for people

    Examples
    --------
    >>> from marey_motion import map_joints, studio_skeleton
    >>> mapping = map_joints(studio_skeleton())
    >>> mapping.joints["left_knee"], mapping.method
    ('LeftLeg', 'names')
    """

    rig: str | None
    joints: Mapping[str, str]
    confidence: float
    method: MappingMethod
    notes: tuple[str, ...] = ()

    @property
    def is_animal(self) -> bool:
        """Whether the skeleton seems to have four legs."""
        return any(note.endswith(_ANIMAL_NOTE) for note in self.notes)

    def indices(self, skeleton: Skeleton, standard_names: Iterable[str]) -> tuple[int, ...]:
        """Look up the joints of standard names.

        Parameters
        ----------
        skeleton : Skeleton    the joints
        standard_names : iterable of str    names to look up

        Returns
        -------
        tuple of int    indices, in the order of the names

        Raises
        ------
        MappingError    naming the standard names that this mapping lacks
        """
        names = tuple(standard_names)
        missing = [name for name in names if name not in self.joints]
        if missing:
            raise MappingError(
                f"the joint mapping contains no joint for {', '.join(missing)}; add the missing joints to the mapping",
                where=missing[0],
            )
        return tuple(skeleton.index_of(self.joints[name]) for name in names)


def map_joints(skeleton: Skeleton) -> JointMapping:
    """Find the standard joints of a skeleton: by the names of a known rig or, failing those, by geometry.

    Never fails: joints that cannot be found are left out and named in the notes, and the confidence is lower.

    Parameters
    ----------
    skeleton : Skeleton    any joints

    Returns
    -------
    JointMapping    standard name to joint name

    Examples
    --------
    >>> from marey_motion import game_skeleton, map_joints
    >>> mapping = map_joints(game_skeleton())
    >>> mapping.joints["left_knee"], mapping.confidence
    ('calf_l', 1.0)
    """
    match = by_names.best_match(skeleton)
    # Everyday words are trusted only where they name a whole body.
    trusted_share = 1.0 if match is not None and match.rig is None else TRUSTED_SHARE
    body = by_geometry.find_body(skeleton) if match is None or match.essential_share < trusted_share else None
    if body is not None and (match is None or len(body.joints.keys() & set(ESSENTIAL_JOINTS)) > match.essential_count):
        rig, joints, confidence, notes = None, dict(body.joints), body.confidence, list(body.notes)
        method: MappingMethod = "geometry"
    elif match is not None:
        rig, joints, confidence, notes = match.rig, dict(match.joints), match.essential_share, []
        method = "names"
        if rig is None:
            notes.append("the rig is not known: joints were found by everyday words for them")
        if match.essential_share < TRUSTED_SHARE:
            rig = None
    else:
        note = "no known names and no two pairs of limbs: this does not look like a body"
        return JointMapping(None, {"root": skeleton.joint_names[0]}, 0.0, "geometry", (note,))
    joints["root"] = 0
    _drop_clavicles_without_length(skeleton, joints)
    joints |= _spine(skeleton, joints)
    missing = [joint for joint in ESSENTIAL_JOINTS if joint not in joints]
    if missing:
        notes.append(f"not found: {', '.join(missing)}")
    signs = _animal_signs(skeleton, joints)
    if signs:
        confidence = min(confidence, ANIMAL_CONFIDENCE)
        notes.append(f"{signs}; {_ANIMAL_NOTE}")
    named = {standard: skeleton.joint_names[joints[standard]] for standard in STANDARD_JOINTS if standard in joints}
    return JointMapping(rig, named, round(confidence, 3), method, tuple(notes))


def require_trust(mapping: JointMapping) -> JointMapping:
    """Refuse a mapping in which hardly any joint was recognised.

    The skeleton may be that of an animal, or the few recognised joints may be wrong. Therefore, a person must check
    such a mapping before it is used.

    Parameters
    ----------
    mapping : JointMapping    result of `map_joints`, or a mapping made by a person

    Returns
    -------
    JointMapping    the same mapping

    Raises
    ------
    MappingError    if the confidence of the mapping is below `LEAST_CONFIDENCE`
    """
    if mapping.confidence < LEAST_CONFIDENCE:
        found = f"the joints of the skeleton were recognised with a confidence of {mapping.confidence:.2f} only"
        reasons = f" ({'; '.join(mapping.notes)})" if mapping.notes else ""
        advice = "correct the mapping with `marey skeleton map`, or confirm it with `marey skeleton map --confirm`"
        raise MappingError(f"{found}{reasons}; {advice}", code="mapping-uncertain")
    return mapping


def symmetric_joints(skeleton: Skeleton, mapping: JointMapping) -> NDArray[np.int32]:
    """Pair each joint with its partner on the other side of the body.

    Partners come from the mapping if the mapping contains both joints. Otherwise, two joints are partners if their
    names differ only in the side. Joints that still have no partner become partners if they are the parents of two
    partners.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    mapping : JointMapping    its standard joints

    Returns
    -------
    (J,) int32    index of the partner; joints of the centre have their own index
    """
    partners = np.arange(skeleton.joint_count, dtype=np.int32)
    by_name = {parse_name(name): index for index, name in enumerate(skeleton.joint_names)}
    for (side, base), index in by_name.items():
        if side:
            other = by_name.get(parse_name(f"{mirrored(f'{side}_')}{base}"))
            partners[index] = index if other is None else other
    for standard, name in mapping.joints.items():
        other_name = mapping.joints.get(mirrored(standard))
        if other_name is not None:
            partners[skeleton.index_of(name)] = skeleton.index_of(other_name)
    for joint in range(skeleton.joint_count - 1, 0, -1):
        parent, other = skeleton.parents[joint], skeleton.parents[partners[joint]]
        if parent != other and parent == partners[parent] and other >= 0 and other == partners[other]:
            partners[[parent, other]] = other, parent
    return partners


def _spine(skeleton: Skeleton, joints: Mapping[str, int]) -> dict[str, int]:
    """Find the joints between pelvis and arms: the lowest, the middle and the one to which the arms are attached.

    Rigs have one to six such joints, under all kinds of names. A single joint is the chest, because the arms are
    attached to it.
    """
    tops = [joints.get(f"{side}_clavicle", joints.get(f"{side}_shoulder")) for side in SIDES]
    if None in tops or "pelvis" not in joints:
        return {}
    left, right = (skeleton.path_to_root(int(top))[1:] for top in tops if top is not None)
    shared = [joint for joint in left if joint in right]
    if joints["pelvis"] not in shared:
        return {}
    upwards = shared[: shared.index(joints["pelvis"])][::-1]
    if joints.get("neck") in upwards:
        upwards = upwards[: upwards.index(joints["neck"])]
    if not upwards:
        return {}
    spine = {"spine_2": upwards[-1]}
    if len(upwards) > 1:
        spine = {"spine": upwards[0]} | spine
    if len(upwards) > 2:
        spine["spine_1"] = upwards[(len(upwards) - 1) // 2]
    return spine


def _drop_clavicles_without_length(skeleton: Skeleton, joints: dict[str, int]) -> None:
    """Remove clavicles at the position of the shoulder: no shoulder line can be read from them."""
    positions = skeleton.rest_global_positions
    for side in SIDES:
        clavicle, shoulder, elbow = (joints.get(f"{side}_{part}") for part in ("clavicle", "shoulder", "elbow"))
        if clavicle is None or shoulder is None or elbow is None:
            continue
        arm = float(np.linalg.norm(positions[elbow] - positions[shoulder]))
        if float(np.linalg.norm(positions[shoulder] - positions[clavicle])) < _SHORTEST_CLAVICLE * arm:
            del joints[f"{side}_clavicle"]


def _animal_signs(skeleton: Skeleton, joints: Mapping[str, int]) -> str:
    """Describe in words the evidence that the skeleton is that of an animal; empty if there is no evidence."""
    for index, name in enumerate(skeleton.display_names):
        base = parse_name(name).base
        is_animal = any(word in base for word in _ANIMAL_WORDS)
        # Hair in a pony tail grows on heads.
        if is_animal and joints.get("head") not in skeleton.path_to_root(index):
            return f"a joint such as {name} belongs to an animal"
    if not set(ESSENTIAL_JOINTS) | {"spine_2"} <= joints.keys():
        return ""
    positions = skeleton.rest_global_positions

    def direction(start: str, end: str) -> NDArray[np.float64]:
        way: NDArray[np.float64] = positions[joints[end]] - positions[joints[start]]
        length = float(np.linalg.norm(way))
        return way / length if length > 0.0 else way

    spine = direction("pelvis", "spine_2")
    hind = [direction(f"{side}_hip", f"{side}_ankle") for side in SIDES]
    front = [direction(f"{side}_shoulder", f"{side}_wrist") for side in SIDES]
    stands_on_all = all(leg @ hind[0] > 0.8 for leg in hind + front) and abs(spine @ hind[0]) < 0.5
    return "the rest pose stands on arms and legs" if stands_on_all else ""
