"""Plan of the import of a batch of files, made from their names alone.

The plan contains, for each file, its companion, the collection and the name of its item, or the reason why it is
refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Literal

from marey_schemas.formats.companions import pair_companions, stem_of

_LONGEST_SEGMENT, _LONGEST_PATH = 255, 1024
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


@dataclass(frozen=True)
class PlannedFile:
    """Plan of the import of one file in a batch.

    Parameters
    ----------
    name : name of the file, as given
    role : `motion` for a file to import; `skeleton` for a file of a skeleton, which is imported and also read together
        with other files; `companion` for a file that is only read together with another file; or `refused`
    companion : name of the companion file that this file needs; None if it needs none
    notes : name of the file with the annotation or the alignment of this file's motion; None if there is none
    folder, item_name : path below the collection that receives the import, and name of the clip
    code, reason : machine-readable code, and reason why the file is refused; empty for other roles
    """

    name: str
    role: Literal["motion", "skeleton", "companion", "refused"]
    folder: str = ""
    item_name: str = ""
    companion: str | None = None
    notes: str | None = None
    code: str = ""
    reason: str = ""

    @property
    def together(self) -> tuple[str, ...]:
        """Names of the files that are read together: this file, its companion and its notes."""
        return tuple(name for name in (self.name, self.companion, self.notes) if name is not None)


def reading_order(plan: Sequence[PlannedFile]) -> list[int]:
    """Return the indices of the files of a plan in the order in which they must be imported.

    Files of skeletons come first: they may contain joint mappings and axes, which clips do not contain. The first file
    with a skeleton creates the item of the skeleton.

    Parameters
    ----------
    plan : sequence of PlannedFile    the plan

    Returns
    -------
    list of int    each index into the plan once
    """
    return sorted(range(len(plan)), key=lambda place: plan[place].role != "skeleton")


def plan_imports(names: Sequence[str]) -> list[PlannedFile]:
    """Plan the import of each file of a batch by its name.

    Folders in the names are created below the collection that receives the import.

    Parameters
    ----------
    names : sequence of str    paths of one upload

    Returns
    -------
    list of PlannedFile    in the order given
    """
    pairings = {pairing.file: pairing for pairing in pair_companions(names)}
    companions = {one.companion: one.shared for one in pairings.values() if one.companion is not None}
    companions |= dict.fromkeys((one.notes for one in pairings.values() if one.notes is not None), False)
    taken: set[tuple[str, str]] = set()
    seen: set[str] = set()
    planned = []
    for name in names:
        one = _place(name, taken)
        pairing = pairings.get(name)
        if name in seen:
            one = replace(one, role="refused", code="name-repeated", reason="another file of the upload has this name")
        elif one.role == "motion" and name in companions:
            own = pairing.companion if pairing is not None and companions[name] else None
            one = replace(one, role="skeleton" if companions[name] else "companion", companion=own)
        elif one.role == "motion" and pairing is not None and pairing.code:
            one = replace(one, role="refused", code=pairing.code, reason=pairing.reason)
        elif one.role == "motion" and pairing is not None:
            one = replace(one, companion=pairing.companion, notes=pairing.notes)
        if one.role == "motion":
            taken.add((one.folder, one.item_name))
        seen.add(name)
        planned.append(one)
    return planned


def _place(name: str, taken: set[tuple[str, str]]) -> PlannedFile:
    path = PurePosixPath(name.replace("\\", "/"))
    segments = [part for part in path.parts if part not in ("/", ".", "..")]
    if not segments or any(len(part) > _LONGEST_SEGMENT for part in segments) or len(name) > _LONGEST_PATH:
        reason = f"each part of a path must have 1 to {_LONGEST_SEGMENT} characters, the path at most {_LONGEST_PATH}"
        return PlannedFile(name, "refused", code="name-invalid", reason=reason)
    if any(_CONTROL.search(part) for part in segments):
        return PlannedFile(
            name, "refused", code="name-invalid", reason="a name must not contain line breaks or control characters"
        )
    folder, stem = "/".join(segments[:-1]), stem_of(segments[-1])
    return PlannedFile(name, "motion", folder, segments[-1] if (folder, stem) in taken else stem)
