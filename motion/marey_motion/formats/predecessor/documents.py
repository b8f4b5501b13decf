"""Reader of any file of Marey's predecessor: a motion, a model, a tree of a model's samples, or a graph of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from marey_motion.formats.predecessor.clips import motion_of_document
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.graph import is_graph
from marey_motion.formats.predecessor.model_layouts import layout_of
from marey_motion.formats.predecessor.tree import is_tree
from marey_motion.importing.source import SourceDocument, SourceMotion, Subject
from marey_schemas.formats import format_named

_MODEL_ENDINGS = ("_quaternion_mm", "_mm")
_TREE_ENDINGS = ("_quaternion_cluster_tree", "_cluster_tree", "_tree")
_SUFFIXES = tuple({PurePosixPath(f"file{ending}").suffix for ending in format_named("predecessor").endings})


def read_predecessor(
    data: bytes,
    file: str,
    *,
    companion: bytes | None = None,
    companion_name: str = "the skeleton document",
    frame_rate_hz: float | None = None,
) -> SourceMotion | SourceDocument:
    """Read a file of Marey's predecessor: a motion, which stays in its own unit and axes, or a document without motion.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    companion : bytes, optional    the skeleton document of a clip
    companion_name : str    name of the file of the skeleton document, for messages
    frame_rate_hz : float, optional    replaces the document's rate

    Returns
    -------
    SourceMotion or SourceDocument    motion in centimetres, or the document of a model, tree or graph

    Raises
    ------
    FormatError    if a document is invalid; the error names the field, and the joint if there is one
    """
    document = decode_document(data, file)
    subject = _subject_of(document)
    if subject is not None:
        return SourceDocument(subject, document)
    return motion_of_document(
        document, file, skeleton=companion, skeleton_file=companion_name, frame_rate_hz=frame_rate_hz
    )


def _subject_of(document: Mapping[str, Any]) -> Subject | None:
    if layout_of(document) is not None:
        return "model"
    if is_tree(document):
        return "tree"
    return "graph" if is_graph(document) else None


def model_name(stem: str) -> str:
    """Derive the name of a model from the name of its file: `walk_leftStance` from `walk_leftStance_quaternion_mm`.

    The stem may still contain a suffix: it is `walk_mm.bson` for the file `walk_mm.bson.bz2`.

    Parameters
    ----------
    stem : str    name of the file without its suffix

    Returns
    -------
    str    name of the model
    """
    return _without(_without(stem, _SUFFIXES), _MODEL_ENDINGS)


def pair_trees(names: Sequence[str]) -> dict[str, str]:
    """Find the tree of each model by the names of the files, such as `walk_mm.json` and `walk_cluster_tree.json`.

    Parameters
    ----------
    names : sequence of str    paths of the files

    Returns
    -------
    dict of str to str    path of the tree by path of the model
    """
    trees: dict[tuple[str, str], str] = {}
    models: dict[tuple[str, str], str] = {}
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        if path.suffix.lower() not in _SUFFIXES:
            continue
        folder, stem = path.parent.as_posix(), path.name.partition(".")[0]
        bare = _without(stem, _TREE_ENDINGS)
        if bare != stem:
            trees[folder, bare] = name
        else:
            models.setdefault((folder, model_name(stem)), name)
    return {model: trees[key] for key, model in models.items() if key in trees}


def _without(stem: str, endings: Sequence[str]) -> str:
    for ending in endings:
        if stem.endswith(ending) and len(stem) > len(ending):
            return stem.removesuffix(ending)
    return stem
