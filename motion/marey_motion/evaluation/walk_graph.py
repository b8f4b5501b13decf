"""Directed graph of the frames that characters display and of the jumps between them.

The terms follow Kovar et al. (2002): clips that can all be reached from each other by jumps form a strongly connected
component; a dead end is a component that jumps enter, but never leave.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from marey_motion.arrays import Ints
from marey_motion.evaluation.relevance import clip_starts, clips_of_rows, count_switches
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import TrialRecord


@dataclass(frozen=True, eq=False)
class WalkGraph:
    """Displayed frames as nodes, jumps between them as edges, and the order of the frames in each trial.

    Parameters
    ----------
    rows : (N,) int64    the nodes: displayed database rows, ascending
    ticks : (N,) int64    number of ticks in which each row was displayed
    edges : (E, 3) int64    row left, row entered and count; ordered by the first two
    walks : for each trial, an array (R, 3) int64 of its R runs without a jump: first tick, first row and number of
        frames
    """

    clips: tuple[DatabaseClip, ...]
    rows: Ints
    ticks: Ints
    edges: Ints
    walks: tuple[Ints, ...]


def walk_graph(clips: Sequence[DatabaseClip], records: Sequence[TrialRecord]) -> WalkGraph:
    """Build the graph of the walks of one or several trials.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    WalkGraph    nodes are database rows
    """
    shown = [record.rows.astype(np.int64) for record in records]
    rows, ticks = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *shown]), return_counts=True)
    walks = tuple(_runs(clips, record) for record in records)
    return WalkGraph(tuple(clips), rows, ticks, count_switches(clips, records), walks)


def _runs(clips: Sequence[DatabaseClip], record: TrialRecord) -> Ints:
    """List the runs (R, 3) of consecutive frames of one clip: first tick, first row and number of frames of each."""
    rows = record.rows.astype(np.int64)
    owners = clips_of_rows(clips, rows)
    firsts = np.concatenate(([0], np.flatnonzero((np.diff(rows) != 1) | (np.diff(owners) != 0)) + 1))
    lengths = np.diff(np.concatenate((firsts, [len(rows)])))
    return np.stack((firsts, rows[firsts], lengths), axis=1)


def graph_to_tree(graph: WalkGraph) -> dict[str, Any]:
    """Convert a graph to plain values for JSON; edges identify their nodes by index.

    Parameters
    ----------
    graph : WalkGraph    the graph

    Returns
    -------
    dict    plain values
    """
    owners = clips_of_rows(graph.clips, graph.rows)
    frames = graph.rows - clip_starts(graph.clips)[owners]
    edges = np.column_stack((np.searchsorted(graph.rows, graph.edges[:, :2]), graph.edges[:, 2]))
    return {
        "clips": [{"uid": clip.uid, "name": clip.name, "frames": clip.frame_count} for clip in graph.clips],
        "nodes": {"clip": owners.tolist(), "frame": frames.tolist(), "ticks": graph.ticks.tolist()},
        "edges": {"source": edges[:, 0].tolist(), "target": edges[:, 1].tolist(), "count": edges[:, 2].tolist()},
        "walks": [_walk_to_tree(graph, walk) for walk in graph.walks],
    }


def _walk_to_tree(graph: WalkGraph, walk: Ints) -> dict[str, list[int]]:
    owners = clips_of_rows(graph.clips, walk[:, 1])
    return {
        "tick": walk[:, 0].tolist(),
        "clip": owners.tolist(),
        "frame": (walk[:, 1] - clip_starts(graph.clips)[owners]).tolist(),
        "frames": walk[:, 2].tolist(),
    }


_GRAPHML_KEYS = (
    ("node", "clip", "string"),
    ("node", "name", "string"),
    ("node", "frame", "long"),
    ("node", "ticks", "long"),
    ("edge", "count", "long"),
)


def graph_to_graphml(graph: WalkGraph, trials: Sequence[str] = ()) -> bytes:
    """Write a graph as GraphML: nodes n<row> with clip, frame and ticks, edges with their count.

    Each walk is an attribute of the graph, walk0 and so on, which lists its runs in order: `n12:30 n140:6` is thirty
    frames from row 12 on, then six from row 140.

    Parameters
    ----------
    graph : WalkGraph    the graph
    trials : sequence of str    names of the walks; walk0 and so on if empty

    Returns
    -------
    bytes    the document
    """
    owners = clips_of_rows(graph.clips, graph.rows)
    frames = graph.rows - clip_starts(graph.clips)[owners]
    names = [(escape(_readable(clip.uid)), escape(_readable(clip.name))) for clip in graph.clips]
    walk_keys = [f"walk{index}" for index in range(len(graph.walks))]
    keys = [(of, name, name, kind) for of, name, kind in _GRAPHML_KEYS]
    keys += [("graph", key, name, "string") for key, name in zip(walk_keys, trials or walk_keys, strict=True)]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<graphml xmlns="http://graphml.graphdrawing.org/xmlns">',
        *(
            f'<key id="{key}" for="{of}" attr.name={quoteattr(_readable(name))} attr.type="{kind}"/>'
            for of, key, name, kind in keys
        ),
        '<graph edgedefault="directed">',
        *(f'<data key="{key}">{_walk_to_text(walk)}</data>' for key, walk in zip(walk_keys, graph.walks, strict=True)),
    ]
    for row, owner, frame, ticks in zip(
        graph.rows.tolist(), owners.tolist(), frames.tolist(), graph.ticks.tolist(), strict=True
    ):
        uid, name = names[owner]
        lines.append(
            f'<node id="n{row}"><data key="clip">{uid}</data><data key="name">{name}</data>'
            f'<data key="frame">{frame}</data><data key="ticks">{ticks}</data></node>'
        )
    lines += [
        f'<edge source="n{left}" target="n{entered}"><data key="count">{count}</data></edge>'
        for left, entered, count in graph.edges.tolist()
    ]
    lines += ["</graph>", "</graphml>", ""]
    return "\n".join(lines).encode()


def _walk_to_text(walk: Ints) -> str:
    return " ".join(f"n{row}:{length}" for _, row, length in walk.tolist())


_NOT_IN_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _readable(text: str) -> str:
    """Replace characters that XML 1.0 does not allow, such as control characters."""
    return _NOT_IN_XML.sub("\ufffd", text)


@dataclass(frozen=True, eq=False)
class ClipGraph:
    """Displayed clips and the jumps between them.

    Parameters
    ----------
    counts : number of jumps for each pair (clip left, clip entered), in ascending order of the pairs; both may be the
        same clip
    components : strongly connected components of the displayed clips, from the largest to the smallest; of equally
        large components, the one with the lowest clip index comes first
    dead_ends : components that were entered and never left
    """

    counts: Mapping[tuple[int, int], int]
    components: tuple[tuple[int, ...], ...]
    dead_ends: tuple[tuple[int, ...], ...]


def clip_graph(clips: Sequence[DatabaseClip], switches: Ints, used: Sequence[int]) -> ClipGraph:
    """Reduce the graph of frames to a graph of clips.

    Parameters
    ----------
    clips : sequence of DatabaseClip    the clips
    switches : (S, 3) int64    row left, row entered and count
    used : sequence of int    indices of the clips that were displayed

    Returns
    -------
    ClipGraph    nodes are clips
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    left, entered = (clips_of_rows(clips, switches[:, column]) for column in (0, 1))
    matrix = coo_array((switches[:, 2], (left, entered)), shape=(len(clips), len(clips))).tocsr()
    _, labels = connected_components(matrix, directed=True, connection="strong")
    members: dict[int, list[int]] = {}
    for clip in sorted(used):
        members.setdefault(int(labels[clip]), []).append(clip)
    pairs = matrix.tocoo()
    order = np.lexsort((pairs.coords[1], pairs.coords[0]))
    counts = {(int(pairs.coords[0][at]), int(pairs.coords[1][at])): int(pairs.data[at]) for at in order.tolist()}
    left_again = {int(labels[a]) for a, b in counts if labels[a] != labels[b]}
    entered_from_elsewhere = {int(labels[b]) for a, b in counts if labels[a] != labels[b]}
    ranked = sorted(members.items(), key=lambda item: (-len(item[1]), item[1][0]))
    return ClipGraph(
        counts=counts,
        components=tuple(tuple(own) for _, own in ranked),
        dead_ends=tuple(
            tuple(own) for label, own in ranked if label in entered_from_elsewhere and label not in left_again
        ),
    )
