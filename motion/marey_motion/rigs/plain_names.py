"""Joint names without the prefixes and suffixes that an exporter added to all names.

Duplicating an armature, joining scenes and converting files leave marks on every joint: "Hips.001", "hero_Hips",
"Hips_jnt", "Hips_07". These marks contain no information about the body, but with them the names do not match the names
of any known rig.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

Names = tuple[str, ...]

# Marks of each kind that are looked for: a namespace within a namespace, a duplicate of a duplicate.
MOST_MARKS = 2
_SEPARATORS = re.compile(r"[^A-Za-z0-9]+")
# What modellers write after the names of joints, in one file mostly after all of them.
_ENDING = re.compile(r"[^A-Za-z0-9]*(jnt|joint|bone|bind|jt)$", re.IGNORECASE)
_NUMBER_AFTER = re.compile(r"[^A-Za-z0-9]+\d+$")
_NUMBER_BEFORE = re.compile(r"^\d+[^A-Za-z0-9]")


def readings(names: Sequence[str]) -> tuple[Names, ...]:
    """List the original names, then versions of them with one more shared mark removed each time.

    The last version separates sides that are written without a capital letter: "lthigh" becomes "l_thigh".

    Parameters
    ----------
    names : sequence of str    names of all joints

    Returns
    -------
    tuple of tuples of str    readings, the first one unchanged

    Examples
    --------
    >>> readings(("Hips.001", "Spine.001", "Head.001"))
    (('Hips.001', 'Spine.001', 'Head.001'), ('Hips', 'Spine', 'Head'))
    """
    found = [tuple(names)]
    for strip in (_without_ending, _without_common_end, _without_numbers, _without_common_start) * MOST_MARKS:
        plainer = strip(found[-1])
        if plainer != found[-1] and all(plainer):
            found.append(plainer)
    sided = _with_sides(found[-1])
    return tuple(found) if sided == found[-1] else (*found, sided)


def _with_sides(names: Names) -> Names:
    """Separate a small l or r at the start of lower-case names, if the skeleton has the same name of the other side."""
    known = set(names)

    def is_sided(name: str) -> bool:
        return name.islower() and name[0] in "lr" and name[1:2].isalpha() and "lr"[name[0] == "l"] + name[1:] in known

    return tuple(f"{name[0]}_{name[1:]}" if is_sided(name) else name for name in names)


def _marked(names: Names) -> Names:
    """List the names of all joints except the root.

    A mark is removed only if all these names have it. The root does not count, because exporters often add a root whose
    name has no mark.
    """
    return names[1:]


def _shared_start(names: Sequence[str]) -> str:
    # All names begin with the text with which both the first and the last name in sorted order begin.
    first, last = min(names, default=""), max(names, default="")
    length = next(
        (at for at, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last))
    )
    return first[:length]


def _without_common_end(names: Names) -> Names:
    """Drop the last separator and the text after it, if all names share this text."""
    shared = _shared_start([name[::-1] for name in _marked(names)])[::-1]
    at = max((found.start() for found in _SEPARATORS.finditer(shared)), default=None)
    return names if at is None else tuple(name.removesuffix(shared[at:]) for name in names)


def _without_common_start(names: Names) -> Names:
    """Drop the first separator and the text before it, if all names share this text."""
    shared = _shared_start(_marked(names))
    found = _SEPARATORS.search(shared)
    return names if found is None else tuple(name.removeprefix(shared[: found.end()]) for name in names)


def _without_numbers(names: Names) -> Names:
    """Remove a number from the end or the beginning of all names, unless two names would then be equal."""
    for number in (_NUMBER_AFTER, _NUMBER_BEFORE):
        plainer = tuple(number.sub("", name) for name in names)
        if all(map(number.search, _marked(names))) and len(set(plainer)) == len(set(names)):
            return plainer
    return names


def _without_ending(names: Names) -> Names:
    """Drop a word for "joint" that most names end in."""
    endings = Counter(found[1].lower() for name in names if (found := _ENDING.search(name)))
    ending, count = endings.most_common(1)[0] if endings else ("", 0)
    if 2 * count <= len(names):
        return names
    marked = re.compile(rf"[^A-Za-z0-9]*{ending}$", re.IGNORECASE)
    return tuple(marked.sub("", name) for name in names)
