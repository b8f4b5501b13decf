"""A tree over samples of a primitive, made by recursive k-means, so that a search evaluates only a few of many samples.

The method is that of Herrmann et al. 2019, section 3. The tree contains the samples themselves, in single precision and
in the order of the tree. So a tree stays valid even if the random generator changes, and the samples of each node are a
contiguous range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats, Ints32
from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search import objective_kernels
from marey_motion.modelling.search import tree_kernels as kernels
from marey_motion.modelling.search.tracking import Tracked, track_points
from marey_schemas.documents.standard_joints import LIMB_ENDS
from marey_schemas.options.modelling import TreeOptions

END_EFFECTORS = (*LIMB_ENDS, "head")
"""Standard joints whose positions can be features of samples."""


DEFAULT_TREE = TreeOptions()


@dataclass(frozen=True, eq=False)
class SampleTree:
    """Samples of a primitive, grouped in a tree.

    Nodes are numbered level by level from the root. The children of a node have consecutive numbers, and each child has
    a part of the node's samples. A node without children is a leaf.

    Parameters
    ----------
    samples : (n, L) float32 latent vectors; the samples of a node are contiguous
    sizes : (M,) number of samples of each node
    children : (M,) number of child nodes of each node
    """

    samples: NDArray[np.float32]
    sizes: Ints32
    children: Ints32

    def __post_init__(self) -> None:
        nodes = len(self.sizes)
        sound = nodes > 0 and self.samples.ndim == 2 and self.sizes.shape == self.children.shape == (nodes,)
        if not sound or self.sizes[0] != len(self.samples) or self.sizes.min() < 1 or self.children.min() < 0:
            raise MotionError("the arrays samples, sizes and children of the tree do not match", code="tree-invalid")
        if 1 + int(self.children.sum()) != nodes or (self.first_children > nodes).any():
            raise MotionError(
                "each node of the tree except the first must have exactly one parent", code="tree-invalid"
            )
        inner = np.flatnonzero(self.children)
        if (self.first_children[inner] <= inner).any():
            raise MotionError("each node of the tree must come after its parent", code="tree-invalid")
        parts = np.add.reduceat(self.sizes, self.first_children[inner]) if inner.size else self.sizes[:0]
        if inner.size and not np.array_equal(parts[: inner.size], self.sizes[inner]):
            raise MotionError(
                "the children of each node of the tree must together have all samples of the node", code="tree-invalid"
            )

    @property
    def dimensions(self) -> int:
        """Number of dimensions L."""
        return int(self.samples.shape[1])

    @cached_property
    def first_children(self) -> Ints32:
        """Index (M,) of each node's first child, int32; meaningless for nodes without children."""
        return np.asarray(1 + np.cumsum(self.children) - self.children, dtype=np.int32)

    @cached_property
    def starts(self) -> Ints32:
        """Index (M,) of each node's first sample, int32."""
        starts = np.zeros(len(self.sizes), dtype=np.int32)
        kernels.locate(self.sizes, self.children, starts)
        return starts

    @cached_property
    def means(self) -> Floats:
        """Mean of each node's samples, (M, L) float64."""
        means = np.empty((len(self.sizes), self.dimensions))
        kernels.average(self.samples, self.starts, self.sizes, means)
        return means

    def most_evaluations(self, candidates: int) -> int:
        """Compute an upper bound of the number of motions that a search evaluates.

        Parameters
        ----------
        candidates : int    nodes that are followed from each level to the next

        Returns
        -------
        int    motions
        """
        total, start, stop = 0, 0, 1
        while start < stop:
            children, sizes = self.children[start:stop], self.sizes[start:stop]
            looked_at = np.where(children > 0, children, np.where(sizes > 1, sizes, 0)).astype(np.int64)
            if len(looked_at) > candidates:
                looked_at = np.partition(looked_at, -candidates)[-candidates:]
            total += int(looked_at.sum())
            start, stop = stop, stop + int(children.sum())
        return total


def build_tree(
    primitive: MotionPrimitive,
    seed: int,
    options: TreeOptions = DEFAULT_TREE,
    *,
    end_effectors: Sequence[int] = (),
) -> SampleTree:
    """Draw samples of a primitive and group them.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    seed : int    the same seed gives the same tree
    options : TreeOptions    number of samples, and shape of the tree
    end_effectors : sequence of int    joint indices; used if samples are clustered by the positions of end effectors

    Returns
    -------
    SampleTree    samples in the order of the tree

    Raises
    ------
    MotionError    if samples are clustered by the positions of end effectors, but no end effector is given
    """
    count = options.samples if primitive.dimensions else 1
    samples = primitive.sample(count, seed).astype(np.float32)
    features = _features(primitive, samples.astype(np.float64), options, end_effectors)
    randoms = np.random.Generator(np.random.Philox([seed, count])).random((2 * count, options.branching))
    order = np.arange(count)
    starts, sizes, children = (np.zeros(2 * count, dtype=np.int64) for _ in range(3))
    nodes = kernels.grow(
        features, randoms, options.branching, options.leaf_size, options.depth, order, starts, sizes, children
    )
    return SampleTree(samples[order], sizes[:nodes].astype(np.int32), children[:nodes].astype(np.int32))


def feature_frames(primitive: MotionPrimitive) -> list[float]:
    """List the canonical frames for features of end effectors: keyframes, middle and end.

    Parameters
    ----------
    primitive : MotionPrimitive    the model

    Returns
    -------
    list of float    canonical frames
    """
    last = primitive.frame_count - 1
    return sorted({*map(float, primitive.keyframes.values()), 0.5 * last, float(last)})


def _features(
    primitive: MotionPrimitive, samples: Floats, options: TreeOptions, end_effectors: Sequence[int]
) -> Floats:
    """Compute the features (n, D) by which n samples are clustered: spatial scores, or positions of end effectors."""
    if options.features == "latent":
        return np.ascontiguousarray(samples[:, : primitive.spatial.count])
    if not end_effectors:
        raise MotionError(
            "the tree is made from the positions of hands, feet and head, but the joint mapping of the skeleton "
            "contains none of them; add them to the mapping",
            where="features",
        )
    frames = feature_frames(primitive)
    chains = track_points(primitive, [Tracked(frame, (joint,)) for frame in frames for joint in end_effectors])
    points = np.empty((len(samples), len(chains.turned), 3))
    objective_kernels.track(chains, np.zeros(3), samples, points)
    return points.reshape(len(samples), -1)
