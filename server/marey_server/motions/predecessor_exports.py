"""Export of annotations, models with their trees, and graphs to the file formats of Marey's predecessor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.graphs import ModelGraph
from marey_schemas.documents.models import checked_model, predecessor_origin, predecessor_time
from marey_schemas.documents.originals import StoredOriginal, content_digest
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.sample_trees import SampleTreeDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.formats import DEFAULT_END_INDEX, DEFAULT_FORM, AnnotationForm, EndIndex
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem, NotFoundProblem

Parts = Mapping[str, dict[str, Any]]

PARTS_OF: dict[Kind, tuple[str, ...]] = {Kind.MODEL: ("model", "tree"), Kind.PROCESSED: ("alignment",)}
"""Parts of items that are separate files in the predecessor's formats, by kind."""


@dataclass(frozen=True, slots=True)
class PredecessorOptions:
    """Options of the file formats of Marey's predecessor.

    `end_index` and `form` apply to annotations, `layout` to models. By default, an unchanged model is exported as its
    imported file; other models are written in the layout that contains their time function exactly, or else in layout 3.
    `part` selects the part of the item to export: for a model, its
    tree; for an aligned clip, its alignment. By default, the model or the motion of the clip is exported.
    """

    end_index: EndIndex = DEFAULT_END_INDEX
    form: AnnotationForm = DEFAULT_FORM
    part: Literal["model", "tree", "alignment"] | None = None
    layout: Literal["2", "3"] | None = None

    def require_part_of(self, kind: Kind) -> None:
        """Raise `InvalidProblem` if items of the kind do not have the requested part."""
        if self.part is not None and self.part not in PARTS_OF.get(kind, ()):
            held = " or ".join(PARTS_OF.get(kind, ())) or "none"
            detail = f"In the predecessor's format, a {kind} has no file for the part {self.part!r}; it has {held}."
            raise InvalidProblem(detail, code="no-part")


def unchanged_original(kind: Kind, parts: Parts, options: PredecessorOptions) -> StoredOriginal | None:
    """Return the file that a model, a tree or a graph was imported from, or None if the requested part was changed.

    Also return None for an item of another kind, and if `options` specifies a layout, because the imported file may
    have another layout. The documents in `parts` may contain references to stored arrays in place of the arrays.
    """
    if options.layout is not None:
        return None
    if kind is Kind.GRAPH:
        known = parts["graph"].get("original")
        return _if_unchanged("graph", parts["graph"], None if known is None else StoredOriginal.model_validate(known))
    if kind is Kind.MODEL:
        origin = predecessor_origin(parts["model"])
        if options.part == "tree":
            return _if_unchanged("tree", parts.get("tree"), origin.tree)
        return _if_unchanged("model", parts["model"], origin.original)
    return None


def _if_unchanged(part: str, document: Mapping[str, Any] | None, known: StoredOriginal | None) -> StoredOriginal | None:
    if document is None or known is None or known.content != content_digest(part, document):
        return None
    return known


def write_predecessor(
    kind: Kind, name: str, parts: Parts, hierarchy: Mapping[str, Any] | None, options: PredecessorOptions
) -> tuple[str, bytes]:
    """Return the name and the bytes of a file in a format of Marey's predecessor.

    Raises `InvalidProblem` if the item cannot be written in such a format. Raises `NotFoundProblem` if a tree is
    requested of a model without a tree.
    """
    from marey_motion.errors import MotionError

    try:
        ending, data = _written(kind, parts, hierarchy, options)
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    return f"{name}{ending}", data


def _written(
    kind: Kind, parts: Parts, hierarchy: Mapping[str, Any] | None, options: PredecessorOptions
) -> tuple[str, bytes]:
    if kind is Kind.ANNOTATION:
        return "_sections.json", _annotation(parts["annotation"], options)
    if kind is Kind.GRAPH:
        return ".json", _graph(parts["graph"])
    if kind is Kind.PROCESSED:
        return "_alignment.json", _alignment(parts["info"])
    if kind is Kind.MODEL and hierarchy is not None:
        if options.part != "tree":
            return "_mm.json", _model(parts["model"], hierarchy, options.layout)
        if "tree" not in parts:
            raise NotFoundProblem(
                "The model has no tree of samples to export; build it first, with `marey tree`.", code="no-part"
            )
        return "_cluster_tree.json", _tree(parts["model"], parts["tree"])
    raise InvalidProblem(f"An item of the kind {kind} can only be exported as json.", code="no-such-export")


def _annotation(part: Mapping[str, Any], options: PredecessorOptions) -> bytes:
    from marey_motion.documents import layer_from_document
    from marey_motion.formats.predecessor.annotation import write_predecessor_annotation

    annotation = Annotation.model_validate(part)
    ends = [segment.end for segment in annotation.segments] + [one.frame + 1 for one in annotation.keyframes]
    layer = layer_from_document(annotation, max(ends, default=1))
    return write_predecessor_annotation(layer, form=options.form, end_index=options.end_index)


def _alignment(part: Mapping[str, Any]) -> bytes:
    """Return the alignment file of Marey's predecessor: the time function, and the sections between keyframes.

    The time function gives the source frame at each canonical frame. Sections are ranges of canonical frames.
    """
    from marey_motion.formats.predecessor.alignment import write_predecessor_alignment

    info = AlignmentInfo.model_validate(part)
    bounds = sorted({0, *info.keyframes.values(), len(info.time_function)})
    return write_predecessor_alignment(info.time_function, list(pairwise(bounds)))


def _model(part: Mapping[str, Any], hierarchy: Mapping[str, Any], layout: Literal["2", "3"] | None) -> bytes:
    """Return the file of a model; without `layout`, in the layout that can contain its time function exactly."""
    from marey_motion.documents import skeleton_from_document
    from marey_motion.formats.predecessor.model_writer import write_predecessor_model
    from marey_motion.formats.predecessor.time_functions import PredecessorTime
    from marey_motion.modelling.primitive_documents import primitive_from_tree
    from marey_motion.modelling.splines import SplineBasis

    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
    primitive = primitive_from_tree(checked_model(part).model_dump(by_alias=True), skeleton)
    known, time = predecessor_time(part), None
    if known is not None:
        time = PredecessorTime(known.form, SplineBasis(known.knots, known.degree), known.mean, known.eigen)
    if layout is None:
        layout = "2" if known is not None and known.form == "increments" else "3"
    animated = predecessor_origin(part).animated_joints
    return write_predecessor_model(primitive, layout=layout, animated_joints=animated, time=time)


def _tree(model: Mapping[str, Any], part: Mapping[str, Any]) -> bytes:
    from marey_motion.formats.predecessor.tree import write_predecessor_tree
    from marey_motion.modelling.search.tree_documents import sample_tree_from_tree

    document = SampleTreeDocument.model_validate(part)
    tree = sample_tree_from_tree(document.model_dump())
    return write_predecessor_tree(tree, len(checked_model(model).spatial.directions), document.options.branching)


def _graph(part: Mapping[str, Any]) -> bytes:
    from marey_motion.formats.predecessor.graph import GraphNode, PredecessorGraph, write_predecessor_graph

    graph = ModelGraph.model_validate(part)
    nodes = {
        (action, name): GraphNode(
            node.source_id or RevisionRef.model_validate(node.model.model_dump()).item,
            node.type,
            tuple((one.action, one.primitive) for one in node.transitions),
        )
        for action, group in graph.actions.items()
        for name, node in group.primitives.items()
    }
    return write_predecessor_graph(PredecessorGraph(nodes, (graph.start.action, graph.start.primitive)))
