"""What a document of the predecessor is about: a motion, a model, a tree over its samples, or a graph of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any, Literal

from marey_motion.formats.detection import PREDECESSOR, detect_format
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.graph import is_graph
from marey_motion.formats.predecessor.model import layout_of
from marey_motion.formats.predecessor.tree import is_tree

Subject = Literal["model", "tree", "graph"]

_MARKS = (b"sspm", b"eigen_vectors_spatial", b"spatial_coeffs", b"indices", b"start_node", b"startNode")
"""A document of none of these words is about a motion, and need not be looked into here."""

_BZ2 = b"BZh"
_MODEL_ENDINGS = ("_quaternion_mm", "_mm")
_TREE_ENDINGS = ("_quaternion_cluster_tree", "_cluster_tree", "_tree")
_SUFFIXES = (".json", ".bson", ".bz2")


def read_document(data: bytes, file: str) -> tuple[Subject, Mapping[str, Any]] | None:
    """A document about anything but a motion, and what it is about; None for motions and for other formats.

    Raises `FormatError` where it is about to be one of these and cannot be decoded.
    """
    if detect_format(data, file) != PREDECESSOR:
        return None
    if not data.startswith(_BZ2) and not any(mark in data for mark in _MARKS):
        return None
    document = decode_document(data, file)
    if layout_of(document) is not None:
        return "model", document
    if is_tree(document):
        return "tree", document
    return ("graph", document) if is_graph(document) else None


def model_name(stem: str) -> str:
    """What a model is called whose file is called so: `walk_leftStance` of `walk_leftStance_quaternion_mm`.

    The stem may still have the first of two suffixes, as in `walk_mm.bson` of `walk_mm.bson.bz2`.
    """
    return _without(_without(stem, _SUFFIXES), _MODEL_ENDINGS)


def pair_trees(names: Sequence[str]) -> dict[str, str]:
    """The tree of each model among files, by their names, as in `walk_mm.json` and `walk_cluster_tree.json`."""
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
