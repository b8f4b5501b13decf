"""Annotations, models with their trees, and graphs as files of the predecessor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

from marey_schemas.alignment import AlignmentInfo
from marey_schemas.documents import Annotation, SkeletonHierarchy
from marey_schemas.graphs import ModelGraph
from marey_schemas.kinds import Kind
from marey_schemas.modelling import MotionPrimitiveDocument
from marey_schemas.originals import StoredOriginal, content_digest
from marey_schemas.references import RevisionRef
from marey_schemas.sample_trees import SampleTreeDocument
from marey_server.errors import Invalid, NotFound

Parts = Mapping[str, dict[str, Any]]

ENDINGS = {"model": "_mm.json", "tree": "_cluster_tree.json", "graph": ".json"}


@dataclass(frozen=True, slots=True)
class PredecessorOptions:
    """What the predecessor's formats leave open.

    `end_index` and `form` are of annotations, `layout` of models; no layout is that of the file that a model was
    imported from, where it has not changed since, and else 3. `part` tells a model from its tree, and what is kept
    beside an aligned clip from the clip.
    """

    end_index: Literal["inclusive", "exclusive"] = "inclusive"
    form: Literal["labels", "list", "frames"] = "labels"
    part: Literal["model", "tree", "alignment"] | None = None
    layout: Literal["2", "3"] | None = None


def unchanged_original(kind: Kind, parts: Parts, options: PredecessorOptions) -> StoredOriginal | None:
    """The file that a model, a tree or a graph was imported from, where it says the same as the part that is asked for.

    Arrays of the parts may be references to what is stored.
    """
    if options.layout is not None:
        return None
    if kind is Kind.GRAPH:
        part, known = "graph", parts["graph"].get("original")
    elif kind is Kind.MODEL and (options.part or "model") in parts:
        part = options.part or "model"
        known = parts["model"].get("provenance", {}).get("predecessor", {}).get(_MEMBERS.get(part))
    else:
        return None
    if known is None or known["content"] != content_digest(part, parts[part]):
        return None
    return StoredOriginal.model_validate(known)


_MEMBERS = {"model": "original", "tree": "tree"}


def write_predecessor(
    kind: Kind, name: str, parts: Parts, hierarchy: Mapping[str, Any] | None, options: PredecessorOptions
) -> tuple[str, bytes]:
    """Name and bytes of a file. Raises `Invalid` where the item has none, `NotFound` for a model without a tree."""
    if kind is Kind.ANNOTATION:
        return f"{name}_sections.json", _annotation(parts["annotation"], options)
    if kind is Kind.GRAPH:
        return f"{name}{ENDINGS['graph']}", _graph(parts["graph"])
    if kind is Kind.PROCESSED:
        return f"{name}_alignment.json", _alignment(parts["info"])
    if kind is Kind.MODEL and hierarchy is not None:
        if options.part != "tree":
            return f"{name}{ENDINGS['model']}", _model(parts["model"], hierarchy, options.layout or "3")
        if "tree" not in parts:
            raise NotFound("The model has no tree.", code="no-part")
        return f"{name}{ENDINGS['tree']}", _tree(parts["model"], parts["tree"])
    raise Invalid(f"A {kind} is exported as json.", code="no-such-export")


def _annotation(part: Mapping[str, Any], options: PredecessorOptions) -> bytes:
    from marey_motion.documents import layer_from_document
    from marey_motion.formats.predecessor_annotation import write_predecessor_annotation

    annotation = Annotation.model_validate(part)
    ends = [segment.end for segment in annotation.segments] + [one.frame + 1 for one in annotation.keyframes]
    layer = layer_from_document(annotation, max(ends, default=1))
    return write_predecessor_annotation(layer, form=options.form, end_index=options.end_index)


def _alignment(part: Mapping[str, Any]) -> bytes:
    """The time function, and the sections that keyframes cut the canonical frames into."""
    from marey_motion.formats.predecessor_alignment import write_predecessor_alignment

    info = AlignmentInfo.model_validate(part)
    bounds = sorted({0, *info.keyframes.values(), len(info.time_function)})
    return write_predecessor_alignment(info.time_function, list(pairwise(bounds)))


def _model(part: Mapping[str, Any], hierarchy: Mapping[str, Any], layout: Literal["2", "3"]) -> bytes:
    from marey_motion.documents import skeleton_from_document
    from marey_motion.errors import MotionError
    from marey_motion.formats.predecessor_model_writer import write_predecessor_model
    from marey_motion.modelling.primitive_documents import primitive_from_tree

    model = MotionPrimitiveDocument.model_validate(part)
    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
    animated = model.provenance.get("predecessor", {}).get("animated_joints", ())
    try:
        primitive = primitive_from_tree(model.model_dump(by_alias=True), skeleton)
        return write_predecessor_model(primitive, layout=layout, animated_joints=tuple(animated))
    except MotionError as error:
        raise Invalid(str(error), code="cannot-be-exported") from error


def _tree(model: Mapping[str, Any], part: Mapping[str, Any]) -> bytes:
    from marey_motion.formats.predecessor_tree import write_predecessor_tree
    from marey_motion.modelling.sample_tree_documents import sample_tree_from_tree

    document = SampleTreeDocument.model_validate(part)
    spatial = len(MotionPrimitiveDocument.model_validate(model).spatial.directions)
    tree = sample_tree_from_tree(document.model_dump())
    return write_predecessor_tree(tree, spatial, document.options.branching)


def _graph(part: Mapping[str, Any]) -> bytes:
    from marey_motion.formats.predecessor_graph import GraphNode, PredecessorGraph, write_predecessor_graph

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
