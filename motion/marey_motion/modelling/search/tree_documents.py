"""Conversion of trees over samples to and from plain values and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from marey_motion.modelling.search.tree import SampleTree
from marey_schemas.documents.references import PartDigestRef
from marey_schemas.options.modelling import TreeOptions

TREE_SCHEMA = "marey/sample-tree@1"

Tree = dict[str, Any]


def sample_tree_to_tree(
    tree: SampleTree, *, model_digest: str | PartDigestRef, seed: int, options: TreeOptions
) -> Tree:
    """Convert samples to the document that is stored as the part `tree` of a model.

    Parameters
    ----------
    tree : SampleTree    the samples
    model_digest : str or PartDigestRef    digest of the part `model` from which the samples were drawn
    seed : int    seed of the samples
    options : TreeOptions    options of the tree

    Returns
    -------
    dict    plain values and arrays
    """
    return {
        "schema": TREE_SCHEMA,
        "model_digest": model_digest if isinstance(model_digest, str) else model_digest.model_dump(),
        "seed": seed,
        "options": options.model_dump(),
        "samples": np.ascontiguousarray(tree.samples),
        "sizes": np.ascontiguousarray(tree.sizes),
        "children": np.ascontiguousarray(tree.children),
    }


def sample_tree_from_tree(tree: Mapping[str, Any]) -> SampleTree:
    """Convert the document that is stored as the part `tree` of a model to a tree of samples.

    Parameters
    ----------
    tree : mapping    the document, as plain values and arrays

    Returns
    -------
    SampleTree    the samples, grouped in a tree

    Raises
    ------
    MotionError    if its nodes do not form a tree
    """
    return SampleTree(*(np.asarray(tree[name]) for name in ("samples", "sizes", "children")))
