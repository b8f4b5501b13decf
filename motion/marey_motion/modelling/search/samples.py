"""Search for the sample of a primitive that meets constraints best (Herrmann et al. 2019, section 3, Equation 1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats, Indices
from marey_motion.errors import MotionError
from marey_motion.modelling.search.objective import Objective
from marey_motion.modelling.search.tree import SampleTree
from marey_schemas.options.searching import CANDIDATES, PASSES

NARROWING = 0.25
"""Factor by which each pass after the first shrinks the distances between samples."""


@dataclass(frozen=True, eq=False)
class FoundSamples:
    """The best samples that a search found, the best first.

    Parameters
    ----------
    samples : (t,) indices of the samples in the tree; -1 for latent vectors from a further pass, which are not samples
    latents : (t, L) latent vectors
    costs : (t,) sums of weight · error / tolerance over the constraints
    evaluations : number of motions that were evaluated
    """

    samples: Indices
    latents: Floats
    costs: Floats
    evaluations: int


def search_tree(objective: Objective, tree: SampleTree, *, candidates: int = CANDIDATES, top: int = 1) -> FoundSamples:
    """Descend a tree with the best nodes of each level, and keep the best samples.

    All children of the candidates of a level are evaluated by the means of their samples; for a candidate without
    children (a leaf), each of its samples is evaluated. The result consists of samples and never of means, because a
    mean need not be a likely motion. Of samples with equal costs, the first in the tree is preferred. If `candidates`
    is at least the number of nodes, the search is exhaustive.

    Parameters
    ----------
    objective : Objective    constraints
    tree : SampleTree    samples of the same primitive
    candidates : int    nodes that are followed from each level to the next
    top : int    samples to return

    Returns
    -------
    FoundSamples    the best samples, the best first

    Raises
    ------
    MotionError    if the samples have another number of dimensions than the model, or if `candidates` or `top` is below
        1
    """
    _check(objective, tree, candidates, top)
    return _descend(objective, tree, candidates, top, lambda latents: latents)


def search_closely(
    objective: Objective, tree: SampleTree, *, candidates: int = CANDIDATES, passes: int = PASSES
) -> FoundSamples:
    """Find the best sample, then better latent vectors close to it, by several runs of `search_tree`.

    Each further pass searches the same tree, but with all samples moved towards the best latent vector so far: the
    distances between the samples are a quarter of the distances in the pass before. The resulting motion is about as
    likely as a sample.

    Parameters
    ----------
    objective : Objective    constraints
    tree : SampleTree    samples of the same primitive
    candidates : int    nodes that are followed from each level to the next
    passes : int    number of searches

    Returns
    -------
    FoundSamples    the best latent vector

    Raises
    ------
    MotionError    if the samples have another number of dimensions than the model, or if `candidates` is below 1
    """
    best = search_tree(objective, tree, candidates=candidates)
    middle = tree.means[0]
    for number in range(1, passes):
        share, centre = NARROWING**number, best.latents[0]
        found = _descend(objective, tree, candidates, 1, lambda latents: centre + share * (latents - middle))  # noqa: B023
        evaluations = best.evaluations + found.evaluations
        better = replace(found, samples=np.full(1, -1)) if found.costs[0] < best.costs[0] else best
        best = replace(better, evaluations=evaluations)
    return best


def _descend(
    objective: Objective, tree: SampleTree, candidates: int, top: int, transform: Callable[[Floats], Floats]
) -> FoundSamples:
    """Return the best `top` samples that a search finds by following `candidates` nodes of each level of a tree.

    The costs are those of the latent vectors after `transform`; the result contains the transformed vectors.
    """
    frontier = np.zeros(1, dtype=np.intp)
    seen, costs, evaluations = [], [], 0
    while frontier.size:
        nodes = _ranges(tree.first_children[frontier], tree.children[frontier])
        leaves = frontier[tree.children[frontier] == 0]
        alone = tree.sizes[nodes] == 1
        samples = np.concatenate((_ranges(tree.starts[leaves], tree.sizes[leaves]), tree.starts[nodes[alone]]))
        nodes = nodes[~alone]
        found = objective.costs(transform(np.concatenate((tree.means[nodes], tree.samples[samples]))))
        seen.append(samples)
        costs.append(found[len(nodes) :])
        evaluations += len(found)
        frontier = nodes[_smallest(found[: len(nodes)], nodes, candidates)]
    best = _best(tree, np.concatenate(seen), np.concatenate(costs), top, evaluations)
    return replace(best, latents=transform(best.latents))


def _check(objective: Objective, tree: SampleTree, candidates: int, top: int) -> None:
    if tree.dimensions != objective.primitive.dimensions:
        held, needed = tree.dimensions, objective.primitive.dimensions
        raise MotionError(
            f"each sample of the tree has {held} numbers, but the model needs {needed}; make a new tree for the model",
            code="tree-of-another",
        )
    if candidates < 1 or top < 1:
        raise MotionError(
            "the number of candidates to follow and the number of samples to return must be at least 1",
            where="candidates",
        )


def _best(tree: SampleTree, samples: Indices, costs: Floats, top: int, evaluations: int) -> FoundSamples:
    chosen = _smallest(costs, samples, top)
    return FoundSamples(samples[chosen], tree.samples[samples[chosen]].astype(np.float64), costs[chosen], evaluations)


def _smallest(costs: Floats, places: Indices, count: int) -> Indices:
    """Return the indices of the `count` smallest numbers in `costs` (n,), in ascending order of cost.

    Equal costs are sorted by `places` (n,), the number of the node or sample of each cost.
    """
    order: Indices = np.lexsort((places, costs))[:count]
    return order


def _ranges(starts: NDArray[np.int32], counts: NDArray[np.int32]) -> Indices:
    """Concatenate ranges of consecutive integers; range i has `counts[i]` integers and begins at `starts[i]`."""
    ends = np.cumsum(counts)
    firsts: Indices = np.repeat(starts - (ends - counts), counts)
    return firsts + np.arange(len(firsts), dtype=np.intp)
