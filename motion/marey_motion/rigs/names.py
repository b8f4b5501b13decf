"""Parsing of joint names: namespaces, words, and the side of the body."""

from __future__ import annotations

import re
from typing import NamedTuple

_WORDS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDE_WORDS = {"l": "left", "left": "left", "r": "right", "right": "right"}


class JointName(NamedTuple):
    """A joint name reduced to its side and its words.

    Parameters
    ----------
    side : str    "left", "right", or "" for the centre
    base : str    the name without side, namespace and separators, in lower case
    """

    side: str
    base: str


def parse_name(name: str) -> JointName:
    """Parse the side and base of a joint name of any style.

    "mixamorig:LeftUpLeg", "L_UpLeg", "upLeg.l" and "UpLeg_L" have the same side and differ at most by a prefix of the
    base. The namespace, which is the text up to the last ":" or "|", is dropped.

    Parameters
    ----------
    name : str    the joint's name in its file

    Returns
    -------
    JointName    side and base

    Examples
    --------
    >>> parse_name("mixamorig:LeftUpLeg")
    JointName(side='left', base='upleg')
    >>> parse_name("CC_Base_R_Thigh")
    JointName(side='right', base='ccbasethigh')
    >>> parse_name("L5")
    JointName(side='', base='l5')
    """
    words = [word.lower() for word in _WORDS.findall(re.split(r"[:|]", name)[-1])]
    for at, word in enumerate(words):
        rest = words[:at] + words[at + 1 :]
        if word in _SIDE_WORDS and any(part.isalpha() for part in rest):
            return JointName(_SIDE_WORDS[word], "".join(rest))
    for at, word in enumerate(words):
        for side in ("left", "right"):
            if word.startswith(side) and len(word) > len(side):
                return JointName(side, "".join((*words[:at], word[len(side) :], *words[at + 1 :])))
    return JointName("", "".join(words))
