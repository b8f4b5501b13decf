"""Hips, head, feet and hands of a body, found by the words in joint names.

Enough to tell which way is up and how tall somebody is, for rigs nobody has mapped yet. The full mapping to standard
joints is another matter (`rigs`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_PARTS = {
    "foot": ("foot", "ankle"),
    "toe": ("toe", "toes", "toebase", "ball", "forefoot"),
    "hand": ("hand", "wrist"),
    "head": ("head",),
    "thigh": ("upleg", "thigh", "femur", "upperleg"),
}
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_GLUED = re.compile(rf"^(left|right|l|r)({'|'.join(word for words in _PARTS.values() for word in words)})s?$")


@dataclass(frozen=True)
class Landmarks:
    """Indices of joints, None where the names tell none.

    `hips` is the last joint that both feet hang from; the pairs are (left, right).
    """

    hips: int | None = None
    head: int | None = None
    feet: tuple[int, int] | None = None
    toes: tuple[int, int] | None = None
    hands: tuple[int, int] | None = None

    @property
    def ground_joints(self) -> tuple[int, ...]:
        """The joints that touch the ground first: toes, else feet."""
        return self.toes or self.feet or ()


def find_landmarks(names: Sequence[str], parents: NDArray[np.int32]) -> Landmarks:
    """Look for the words of each part; of several joints that fit, the one nearest to the root is taken."""
    depths = _depths(parents)
    found: dict[tuple[str, str], int] = {}
    for joint, name in enumerate(names):
        side, part = _read_name(name)
        if part and ((side, part) not in found or depths[joint] < depths[found[side, part]]):
            found[side, part] = joint
    feet = _pair(found, "foot") or _pair(found, "toe")
    toes = _pair(found, "toe")
    return Landmarks(
        hips=common_ancestor(parents, feet) if feet else None,
        head=found.get(("", "head")),
        feet=feet,
        toes=toes,
        hands=_pair(found, "hand"),
    )


def path_length(parents: NDArray[np.int32], offsets: NDArray[np.float64], top: int, end: int) -> float:
    """Length of the bones from joint `top` down to joint `end`."""
    length = 0.0
    while end != top:
        length += float(np.linalg.norm(offsets[end]))
        end = int(parents[end])
    return length


def _read_name(name: str) -> tuple[str, str]:
    """Side ("left", "right" or "") and part ("" for none) that a name speaks of."""
    words = [word.lower() for word in _WORD.findall(name)]
    side = part = ""
    for word in words:
        if glued := _GLUED.match(word):
            side, word = _SIDES[glued[1]], glued[2]
        side = side or _SIDES.get(word, "")
        part = next((key for key, spelled in _PARTS.items() if word in spelled), part)
    joined = "".join(word for word in words if word not in _SIDES)
    if part in ("", "foot"):
        part = next((key for key in ("thigh", "toe") if any(word in joined for word in _PARTS[key] if len(word) > 4)), part)
    return side, part


def _pair(found: dict[tuple[str, str], int], part: str) -> tuple[int, int] | None:
    left, right = found.get(("left", part)), found.get(("right", part))
    return (left, right) if left is not None and right is not None else None


def _depths(parents: NDArray[np.int32]) -> list[int]:
    depths: list[int] = []
    for parent in parents.tolist():
        depths.append(depths[parent] + 1 if parent >= 0 else 0)
    return depths


def common_ancestor(parents: NDArray[np.int32], pair: tuple[int, int]) -> int:
    """The last joint that both joints hang from."""
    a, b = pair
    while a != b:
        if a > b:
            a = int(parents[a])
        else:
            b = int(parents[b])
    return a
