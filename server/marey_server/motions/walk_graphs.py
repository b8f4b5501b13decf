"""Walk graph of an evaluation, computed in a child process: the displayed frames and the jumps between them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from marey_schemas.kinds import Kind
from marey_schemas.wording import listed
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import Message, pack_tree, unpack_tree
from marey_server.store import items
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:
    from marey_motion.matching.database import DatabaseClip
    from marey_motion.matching.record import TrialRecord

WalkGraphFormat = Literal["json", "graphml"]
MEDIA_TYPES: Mapping[WalkGraphFormat, str] = {"json": "application/json", "graphml": "application/graphml+xml"}
MAKE_WALK_GRAPH = "marey_server.motions.walk_graphs:make_walk_graph"
"""Function that child processes run."""
SCHEMA = "marey/walk-graph@1"


@dataclass(frozen=True, slots=True)
class WalkSource:
    """Documents of an evaluation from which its walk graph is computed."""

    name: str
    evaluation: Mapping[str, Any]
    records: Mapping[str, Any]


class WalkOrder(Message):
    """Message that asks a child process to write the walk graph of one trial, or of all trials together."""

    name: str
    evaluation: bytes
    records: bytes
    trial: str | None
    format: WalkGraphFormat


def read_walks(tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None) -> WalkSource:
    """Read an evaluation and the displayed frames of its trials.

    Raises `NotFoundProblem` if the item is not an evaluation, or does not exist.
    """
    if kind is not Kind.EVALUATION:
        raise NotFoundProblem(
            f"Only evaluations have a walk graph, not an item of the kind {kind}.", code="not-an-evaluation"
        )
    name = items.read_item(tx, project, kind, item_id).name
    evaluation, records = (
        items.read_part(tx, project, kind, item_id, part, revision=revision).tree for part in ("evaluation", "records")
    )
    return WalkSource(name, evaluation, records)


def walk_order(source: WalkSource, trial: str | None, form: WalkGraphFormat) -> bytes:
    """Return the packed message that asks a child process to write a walk graph."""
    return WalkOrder(
        name=source.name,
        evaluation=pack_tree(source.evaluation),
        records=pack_tree(source.records),
        trial=trial,
        format=form,
    ).pack()


# -- in the child ------------------------------------------------------------------------------------------------------


def make_walk_graph(packed: bytes) -> bytes:
    """Compute a walk graph, in a child process. `packed` is a `WalkOrder` as bytes; the result is the graph's file."""
    order = WalkOrder.unpack(packed)
    source = WalkSource(order.name, unpack_tree(order.evaluation), unpack_tree(order.records))
    return write_walk_graph(source, order.trial, order.format)


def write_walk_graph(source: WalkSource, trial: str | None, form: WalkGraphFormat) -> bytes:
    """Compute the walk graph of one trial, or of all trials together (`trial` is None); return it as a file.

    Raises `NotFoundProblem` for an unknown trial, and `InvalidProblem` if the documents contradict each other.
    """
    from marey_motion.errors import MotionError
    from marey_motion.evaluation.result_documents import clips_from_tree, records_from_tree
    from marey_motion.evaluation.walk_graph import graph_to_graphml, graph_to_tree, walk_graph

    try:
        clips, records = clips_from_tree(source.evaluation), records_from_tree(source.records)
        _require_rows(clips, records.values())
    except (MotionError, AttributeError, KeyError, TypeError, ValueError) as error:
        explained = isinstance(error, MotionError) or type(error) is ValueError
        reason = str(error) if explained else f"its documents are malformed ({error!r})"
        detail = f"The walk graph of this evaluation cannot be computed: {reason}. Run the evaluation again."
        raise InvalidProblem(detail, code="not-a-walk") from error
    if trial is not None and trial not in records:
        known = listed(list(records))
        raise NotFoundProblem(f"The evaluation has no trial {trial!r}; it has {known}.", code="no-trial")
    trials = list(records) if trial is None else [trial]
    graph = walk_graph(clips, [records[one] for one in trials])
    if form == "graphml":
        return graph_to_graphml(graph, trials)
    return json.dumps({"schema": SCHEMA, "trials": trials, **graph_to_tree(graph)}).encode()


def _require_rows(clips: Sequence[DatabaseClip], records: Iterable[TrialRecord]) -> None:
    """Raise `ValueError` if there are gaps between the rows of clips, or if a trial displayed a row that no clip has.

    A row is a frame in the database of all clips.
    """
    rows = 0
    for clip in clips:
        if clip.start != rows or clip.stop < rows:
            raise ValueError(
                f"the clip {clip.name!r} has the rows {clip.start} to {clip.stop}, but the rows of "
                f"the clips before it end at {rows}"
            )
        rows = clip.stop
    for record in records:
        if len(record.rows) and not 0 <= record.rows.min() <= record.rows.max() < rows:
            raise ValueError(f"a trial refers to a row that does not exist; the clips have {rows} rows")
