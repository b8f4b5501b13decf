"""Files that an import reads together, found by their names. Client and server must pair files in the same way.

An AMC needs its ASF. In the format of Marey's predecessor, a clip needs its skeleton, and a model may have a tree, a
skeleton a skeleton model (joint mapping and axes). A motion file of any format may have notes: the predecessor's
annotation of the motion, or the alignment of an aligned clip.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import PurePosixPath

from marey_schemas.formats import FORMATS, FileFormat, format_named
from marey_schemas.names import base_name

_PREDECESSOR = format_named("predecessor")
_ENDINGS = sorted((*_PREDECESSOR.endings, *_PREDECESSOR.other_endings), key=len, reverse=True)
_MODEL_ENDINGS = ("_quaternion_mm", "_mm")
TREE_ENDINGS = ("_quaternion_cluster_tree", "_cluster_tree", "_tree")
"""Endings that the names of files with trees have after the name of the model, without the file ending."""
_NOTES_ENDINGS = ("_sections", "_annotations", "_annotation", "_alignment")
_SKELETON = "skeleton"
_SKELETON_MODEL = "skeleton_model"


@dataclass(frozen=True)
class Pairing:
    """File that needs or may have a companion or notes, with the files that were found for it.

    Parameters
    ----------
    file : name of the file
    companion : name of its companion; None if there is none
    beside : names of the files that an import must contain besides `file` in order to pair `file` in this way
    notes : name of the file with its annotation or alignment; None if there is none
    shared : whether the companion is also imported on its own
    code, reason : why the file is refused without a companion; empty if the file has a companion or does not need one
    """

    file: str
    companion: str | None
    beside: tuple[str, ...]
    notes: str | None = None
    shared: bool = False
    code: str = ""
    reason: str = ""


_Files = Sequence[tuple[str, str]]
"""Files of one folder, each as a pair of the name of the file and its path as given."""


def pair_companions(names: Iterable[str]) -> tuple[Pairing, ...]:
    """Return a pairing for every file that needs or may have a companion.

    Only files in the same folder are paired. A companion matches if both files have the same stem, or if the stem of
    the file consists of the stem of the companion, a separator and more text (16.asf for 16_01.amc, 07.asf for
    07_01-walk.amc). Of several matches, the one with the longest stem is chosen. If none matches, and the folder has
    only one possible companion, this file is chosen.

    The name of a skeleton of the predecessor ends in `skeleton` (walk_skeleton.json, walk.skeleton), and its stem is
    the text before this word. If there is no text before it (skeleton.json), the skeleton matches every file. Three
    kinds of files have the name of another file with a different ending: a tree the name of its model
    (walk_cluster_tree.json for walk_mm.json), a skeleton model the name of its skeleton (walk_skeleton_model.json for
    walk_skeleton.json or walk.skeleton), and notes the name of their motion (walk_sections.json or walk_alignment.json
    for walk.bson.bz2 or walk.bvh).
    """
    folders: defaultdict[str, dict[str, str]] = defaultdict(dict)
    for name in sorted(names):
        path = PurePosixPath(name.replace("\\", "/"))
        folders[path.parent.as_posix()][path.name] = name
    pairings: list[Pairing] = []
    for folder in folders.values():
        notes = _notes_of(folder)
        described = set(notes.values())
        found: dict[str, Pairing] = {}
        for row in FORMATS:
            if row.companion is not None:
                files = [(name, path) for name, path in folder.items() if path not in described]
                paired = _pairings_of_predecessor(files) if row is _PREDECESSOR else _pairings(row, files)
                found |= {one.file: one for one in paired}
        for file, note in notes.items():
            pairing = found.get(file, Pairing(file, None, ()))
            found[file] = replace(pairing, notes=note, beside=(*pairing.beside, note))
        pairings += found.values()
    return tuple(pairings)


def _notes_of(folder: Mapping[str, str]) -> dict[str, str]:
    """Map the files of motions in a folder to the files with their notes; `folder` maps names of files to paths.

    If several files have the same stem, the first one has the notes.
    """
    stems = {stem_of(name): path for name, path in folder.items() if _PREDECESSOR.names(name)}
    found: dict[str, str] = {}
    for name, path in folder.items():
        row = next((one for one in FORMATS if one.names(name)), None)
        if row is None or "motion" not in row.reads or is_skeleton_name(name):
            continue
        stem = stem_of(name)
        note = next((stems[stem + end] for end in _NOTES_ENDINGS if stem + end in stems), None)
        if note is not None and note not in found.values():
            found[path] = note
    return found


def stem_of(name: str) -> str:
    """Return the name of a file without folders and ending; the ending may have two parts, as in `walk.bson.bz2`."""
    name = base_name(name)
    if not _PREDECESSOR.names(name):
        return PurePosixPath(name).stem
    ending = next(one for one in _ENDINGS if name.lower().endswith(one))
    return name[: -len(ending)] or name


def model_name(stem: str) -> str:
    """Return the name of a model by the stem of its file: `walk_left` for `walk_left_quaternion_mm`."""
    return _without(stem_of(stem) if _PREDECESSOR.names(stem) else stem, _MODEL_ENDINGS)


def is_skeleton_name(name: str) -> bool:
    """Return whether a file has the name of a skeleton in the format of the predecessor."""
    name = base_name(name).lower()
    return _PREDECESSOR.names(name) and (name.endswith(f".{_SKELETON}") or stem_of(name).endswith(_SKELETON))


def _pairings(row: FileFormat, files: _Files) -> Iterator[Pairing]:
    """Pair the files of a folder whose format needs a companion."""
    wanted = str(row.companion)
    companions = {stem_of(name).lower(): path for name, path in files if format_named(wanted).names(name)}
    for name, path in files:
        if not row.names(name):
            continue
        found, beside = _best(stem_of(name), companions)
        code = reason = ""
        if found is None:
            code = f"{wanted}-missing"
            reason = f"there is no {wanted.upper()} file in its folder; {row.needs_companion}"
            if companions:
                reason = f"none of the {wanted.upper()} files in its folder has a matching name"
        yield Pairing(path, found, beside, code=code, reason=reason)


def _pairings_of_predecessor(files: _Files) -> Iterator[Pairing]:
    """Pair the models of a folder with their trees, and its clips with their skeletons.

    Every file that is not named like a model, tree or skeleton is taken for a clip. So other files, such as graphs, are
    also paired with a skeleton; their import ignores it.
    """
    known = [(stem_of(name), path) for name, path in files if _PREDECESSOR.names(name)]
    skeletons = {_skeleton_stem(stem).lower(): path for stem, path in known if is_skeleton_name(path)}
    joint_models = {_skeleton_stem(stem.removesuffix("_model")).lower(): path for stem, path in known if _maps(stem)}
    others = [(stem, path) for stem, path in known if not is_skeleton_name(path) and not _maps(stem)]
    models: dict[str, str] = {}
    for stem, path in sorted(others, key=lambda one: model_name(one[0]) == one[0]):  # first those called models
        models.setdefault(model_name(stem), path)
    trees = {_without(stem, TREE_ENDINGS): path for stem, path in others if _without(stem, TREE_ENDINGS) != stem}
    for stem, path in skeletons.items():
        if stem in joint_models:
            yield Pairing(path, joint_models[stem], (joint_models[stem],))
    for stem, path in others:
        model, bare = model_name(stem), _without(stem, TREE_ENDINGS)
        if model in trees and models[model] == path:
            yield Pairing(path, trees[model], (trees[model],))
        elif skeletons and model == stem and (bare == stem or bare not in models):
            found, beside = _best(stem, skeletons)
            named = [
                joint_models[one] for one, skeleton in skeletons.items() if skeleton == found and one in joint_models
            ]
            yield Pairing(path, found, (*beside, *named), shared=True)


def _maps(stem: str) -> bool:
    """Return whether a file with this stem (its name without ending) is named like a skeleton model."""
    return stem.lower().endswith(_SKELETON_MODEL)


def _skeleton_stem(stem: str) -> str:
    """Return the stem of the clips that a skeleton matches; it is empty if the skeleton matches all clips."""
    bare = stem[: -len(_SKELETON)] if stem.lower().endswith(_SKELETON) else stem
    return bare.rstrip("_-. ")


def _best(stem: str, companions: Mapping[str, str]) -> tuple[str | None, tuple[str, ...]]:
    """Return the best match for a stem, or None, and the files that an import needs to find the same result.

    `companions` maps the stems of possible companions, in lower case, to their paths. Without a match, the second value
    contains two companions, because a single companion would be the match.
    """
    stem = stem.lower()
    ends = [len(stem), *(end for end in range(len(stem) - 1, 0, -1) if not stem[end].isalnum()), 0]
    found = next((companions[stem[:end]] for end in ends if stem[:end] in companions), None)
    if found is None and len(companions) == 1:
        (found,) = companions.values()
    return found, tuple(islice(companions.values(), 2)) if found is None else (found,)


def _without(stem: str, endings: Iterable[str]) -> str:
    for ending in endings:
        if stem.endswith(ending) and len(stem) > len(ending):
            return stem.removesuffix(ending)
    return stem
