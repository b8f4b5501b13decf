"""Compiled k-means over ranges of samples, in a separate module so that importing other modules does not load numba.

Everything runs in one thread and in a fixed order: the same samples and the same random numbers give the same tree.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled

MOST_ROUNDS = 25
"""Maximum number of rounds of Lloyd's algorithm; further rounds gain little."""


@compiled
def _square_distance(a, b):
    total = 0.0
    for d in range(a.shape[0]):
        step = a[d] - b[d]
        total += step * step
    return total


@compiled
def _place_centres(features, members, randoms, nearest, centres):
    """Choose cluster centres among members by k-means++ (Arthur and Vassilvitskii 2007); return the number of centres.

    `members` are row numbers of `features`; `randoms` are uniform random numbers, one per centre. `centres` is filled;
    `nearest` has space for one distance per member.
    """
    count = members.shape[0]
    centres[0] = features[members[min(int(randoms[0] * count), count - 1)]]
    for m in range(count):
        nearest[m] = np.inf
    for chosen in range(1, centres.shape[0]):
        total = 0.0
        for m in range(count):
            nearest[m] = min(nearest[m], _square_distance(features[members[m]], centres[chosen - 1]))
            total += nearest[m]
        if not total > 0.0:
            return chosen
        left, pick = randoms[chosen] * total, -1
        for m in range(count):
            if nearest[m] > 0.0:
                pick = m
                left -= nearest[m]
                if left < 0.0:
                    break
        centres[chosen] = features[members[pick]]
    return centres.shape[0]


@compiled
def _assign(features, members, centres, labels):
    """Fill `labels` with the index of each member's nearest centre; of equally near centres, the first is taken.

    Returns the number of members whose label has changed.
    """
    changed = 0
    for m in range(members.shape[0]):
        best, label = np.inf, 0
        for centre in range(centres.shape[0]):
            distance = _square_distance(features[members[m]], centres[centre])
            if distance < best:
                best, label = distance, centre
        changed += labels[m] != label
        labels[m] = label
    return changed


@compiled
def _average(features, members, labels, centres, sizes):
    """Move each of `centres` to the mean of its members, and fill `sizes` with the numbers of members.

    A centre without members does not move.
    """
    sums = np.zeros(centres.shape)
    sizes[:] = 0
    for m in range(members.shape[0]):
        sizes[labels[m]] += 1
        for d in range(features.shape[1]):
            sums[labels[m], d] += features[members[m], d]
    for centre in range(centres.shape[0]):
        if sizes[centre]:
            centres[centre] = sums[centre] / sizes[centre]


@compiled
def _split(features, members, randoms, sizes, room):
    """Divide members into clusters by k-means: sort `members` by cluster in place, and fill `sizes` of the clusters.

    `randoms` are uniform random numbers, one per cluster; `room` has arrays for intermediate results. Returns the
    number of clusters.
    """
    nearest, labels, ordered = room
    count = members.shape[0]
    centres = np.empty((sizes.shape[0], features.shape[1]))
    placed = _place_centres(features, members, randoms, nearest[:count], centres)
    centres, labels = centres[:placed], labels[:count]
    labels[:] = -1
    sizes[:] = 0
    for _ in range(MOST_ROUNDS):
        changed = _assign(features, members, centres, labels)
        _average(features, members, labels, centres, sizes)
        if not changed:
            break
    filled, place = 0, 0
    for centre in range(placed):
        size = sizes[centre]
        if size:
            for m in range(count):
                if labels[m] == centre:
                    ordered[place] = members[m]
                    place += 1
            sizes[filled] = size
            filled += 1
    sizes[filled:] = 0
    members[:] = ordered[:count]
    return filled


@compiled
def grow(features, randoms, branching, leaf_size, depth, order, starts, sizes, children):
    """Split samples (n, D) recursively, level by level; return the number of nodes.

    `order` (n,) is permuted so that each node's members are contiguous; `starts`, `sizes` and `children` (nodes,) are
    filled per node: first member, number of members, number of child nodes. The children of a node have consecutive
    numbers, and the nodes of a level are in the order of their parents. A node has up to `branching` children; a node
    with at most `leaf_size` samples, at level `depth`, or whose samples have equal features, has none. `randoms`
    (nodes, branching) are uniform random numbers.
    """
    count = features.shape[0]
    room = (np.empty(count), np.empty(count, np.int64), np.empty(count, np.int64))
    parts = np.empty(branching, np.int64)
    starts[0], sizes[0] = 0, count
    nodes, level_end, level = 1, 1, 0
    node = 0
    while node < nodes:
        if node == level_end:
            level, level_end = level + 1, nodes
        start, size = starts[node], sizes[node]
        children[node] = 0
        if size > leaf_size and level < depth:
            filled = _split(features, order[start : start + size], randoms[node], parts, room)
            if filled > 1:
                children[node] = filled
                for part in range(filled):
                    starts[nodes], sizes[nodes] = start, parts[part]
                    start += parts[part]
                    nodes += 1
        node += 1
    return nodes


@compiled
def locate(sizes, children, starts):
    """Fill `starts` with the index of the first sample of each node.

    The samples of a node are those of its first child, then those of its second child, and so on.
    """
    starts[0] = 0
    following = 1
    for node in range(sizes.shape[0]):
        start = starts[node]
        for child in range(following, following + children[node]):
            starts[child] = start
            start += sizes[child]
        following += children[node]


@compiled
def average(samples, starts, sizes, means):
    """Fill `means` (nodes, L) with the means of nodes; node i has `sizes[i]` samples, beginning at `starts[i]`."""
    means[:] = 0.0
    for node in range(sizes.shape[0]):
        for sample in range(starts[node], starts[node] + sizes[node]):
            for d in range(samples.shape[1]):
                means[node, d] += samples[sample, d]
        for d in range(samples.shape[1]):
            means[node, d] /= sizes[node]
