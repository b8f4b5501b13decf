"""Trees over samples to and from trees of plain values and arrays that travel and are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from marey_motion.modelling.search.tree import SampleTree, TreeOptions
from marey_schemas.documents.references import PartDigestRef

TREE_SCHEMA = "marey/sample-tree@1"

Tree = dict[str, Any]


def sample_tree_to_tree(
    tree: SampleTree, *, model_digest: str | PartDigestRef, seed: int, options: TreeOptions
) -> Tree:
    """Part `tree` of a model.

    Parameters
    ----------
    model_digest : of the part `model` that the samples are of
    seed, options : that it was made with
    """
    return {
        "schema": TREE_SCHEMA,
        "model_digest": model_digest if isinstance(model_digest, str) else model_digest.model_dump(),
        "seed": seed,
        "options": asdict(options),
        "samples": np.ascontiguousarray(tree.samples),
        "sizes": np.ascontiguousarray(tree.sizes),
        "children": np.ascontiguousarray(tree.children),
    }


def sample_tree_from_tree(tree: Mapping[str, Any]) -> SampleTree:
    """The tree of a part `tree`. Raises `MotionError` where its nodes are none of a tree."""
    return SampleTree(*(np.asarray(tree[name]) for name in ("samples", "sizes", "children")))
