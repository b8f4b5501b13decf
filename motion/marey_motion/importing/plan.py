"""Plan of the import of a batch of files, made from their names alone.

The plan contains, for each file, its companion, the collection and the name of its item, or the reason why it is
refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Literal

from marey_motion.formats.predecessor.documents import pair_trees
from marey_schemas.formats import IMPORTED, FileFormat, format_named

_LONGEST_SEGMENT, _LONGEST_PATH = 255, 1024
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")

_Paths = list[tuple[PurePosixPath, str]]


@dataclass(frozen=True)
class PlannedFile:
    """Plan of the import of one file in a batch.

    Parameters
    ----------
    name : name of the file, as given
    role : `motion` or `skeleton` for a file to import, `companion` for a file that is read with another file, or
        `refused`
    companion : name of the companion file that this file needs; None if it needs none
    folder, item_name : path below the collection that receives the import, and name of the clip
    reason : reason why the file is refused; empty for other roles
    """

    name: str
    role: Literal["motion", "skeleton", "companion", "refused"]
    folder: str = ""
    item_name: str = ""
    companion: str | None = None
    code: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Pairing:
    """A file and the companion it needs; if there is none, `code` and `reason` explain why."""

    file: str
    companion: str | None
    code: str = ""
    reason: str = ""


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
    companions = {pairing.file: pairing for pairing in pair_companions(names)}
    trees = pair_trees(names)
    needed = {*trees.values(), *(one.companion for one in companions.values() if one.companion is not None)}
    taken: set[tuple[str, str]] = set()
    seen: set[str] = set()
    planned = []
    for name in names:
        one = _place(name, taken)
        pairing = companions.get(name)
        if name in seen:
            one = replace(one, role="refused", code="name-repeated", reason="another file of the upload has this name")
        elif one.role == "motion" and name in needed:
            one = replace(one, role="companion")
        elif one.role == "motion" and pairing is not None and pairing.companion is None:
            one = replace(one, role="refused", code=pairing.code, reason=pairing.reason)
        elif one.role == "motion" and (pairing is not None or name in trees):
            one = replace(one, companion=pairing.companion if pairing is not None else trees[name])
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
    folder, stem = "/".join(segments[:-1]), PurePosixPath(segments[-1]).stem
    return PlannedFile(name, "motion", folder, segments[-1] if (folder, stem) in taken else stem)


def pair_companions(names: Iterable[str]) -> tuple[Pairing, ...]:
    """Find the companion of every file that needs one, such as the ASF of an AMC.

    Only files in the same folder are considered. A companion matches if both files have the same stem, or if the stem
    of the file consists of the stem of the companion, a separator and more text (16.asf for 16_01.amc, 07.asf for
    07_01-walk.amc). Of several matches, the one with the longest stem is chosen. If none matches, and the folder has
    only one file of the companion's format, this file is chosen.

    Parameters
    ----------
    names : iterable of str    paths of one upload

    Returns
    -------
    tuple of Pairing    one for each file that needs a companion
    """
    paths = sorted({PurePosixPath(name.replace("\\", "/")): name for name in names}.items())
    pairings: list[Pairing] = []
    for row in IMPORTED:
        if row.companion is None or not row.needs_companion:
            continue
        companions: dict[PurePosixPath, _Paths] = {}
        for path, name in paths:
            if format_named(row.companion).names(path.name):
                companions.setdefault(path.parent, []).append((path, name))
        pairings += (
            _pairing(row, path, name, companions.get(path.parent, [])) for path, name in paths if row.names(name)
        )
    return tuple(pairings)


def _pairing(row: FileFormat, path: PurePosixPath, name: str, companions: _Paths) -> Pairing:
    stem = path.stem.lower()
    matching = [
        (len(other.stem), other_name)
        for other, other_name in companions
        if stem == other.stem.lower() or (stem.startswith(other.stem.lower()) and not stem[len(other.stem)].isalnum())
    ]
    if matching:
        return Pairing(name, max(matching)[1])
    if len(companions) == 1:
        return Pairing(name, companions[0][1])
    wanted = str(row.companion)
    if companions:
        reason = f"none of the {len(companions)} {wanted.upper()} files in its folder has a matching name"
    else:
        reason = f"there is no {wanted.upper()} file in its folder; {row.needs_companion}"
    return Pairing(name, None, f"{wanted}-missing", reason)
