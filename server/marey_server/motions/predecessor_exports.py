"""Export of items to the file formats of Marey's predecessor.

An item that is unchanged since its import is exported as the imported file. Otherwise, a new file is written, except
for the motion of clips and for records, of which no new file can be written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.graphs import ModelGraph
from marey_schemas.documents.models import checked_model, predecessor_origin, predecessor_time
from marey_schemas.documents.originals import StoredOriginal, content_digest
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.sample_trees import SampleTreeDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.formats import DEFAULT_END_INDEX, DEFAULT_FORM, AnnotationForm, EndIndex
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem, NotFoundProblem

if TYPE_CHECKING:  # numeric modules take a second to load
    from marey_motion.formats.predecessor.skeleton import SkeletonForm

Parts = Mapping[str, dict[str, Any]]

PARTS_OF: dict[Kind, tuple[str, ...]] = {
    Kind.MODEL: ("model", "tree"),
    Kind.PROCESSED: ("alignment",),
    Kind.SKELETON: ("skeleton", "skeleton_model"),
}
"""Parts of items that are separate files in the predecessor's formats, by kind."""
LAYOUTS_OF: dict[Kind, tuple[str, ...]] = {Kind.MODEL: ("2", "3"), Kind.SKELETON: ("database", "file")}
"""Layouts in which the predecessor has files of a kind."""
DOCUMENTS_OF: dict[Kind, tuple[str, ...]] = {
    Kind.SKELETON: ("hierarchy", "mapping"),
    Kind.CLIP: ("motion", "info"),
    Kind.PROCESSED: ("motion", "info"),
    Kind.ANNOTATION: ("annotation",),
    Kind.MODEL: ("model", "tree"),
    Kind.GRAPH: ("graph",),
    Kind.RECORD: ("record",),
}
"""Parts of items that are read to find the file that an item was imported from."""

ExportPart = Literal["model", "tree", "alignment", "skeleton", "skeleton_model"]
ExportLayout = Literal["2", "3", "database", "file"]


@dataclass(frozen=True, slots=True)
class PredecessorOptions:
    """Options of the file formats of Marey's predecessor.

    `end_index` and `form` apply to annotations, `layout` to models and skeletons. If none of them is given, an item
    that is unchanged since its import is exported as the imported file. Any other model is written in the layout that
    contains its time function exactly, or else in layout 3. `part` selects the part of the item to export: for a
    model, its tree; for an aligned clip, its alignment; for a skeleton, its skeleton model. By default, the model, the
    motion of the clip or the skeleton is exported.
    """

    end_index: EndIndex | None = None
    form: AnnotationForm | None = None
    part: ExportPart | None = None
    layout: ExportLayout | None = None

    def require_fit(self, kind: Kind) -> None:
        """Raise `InvalidProblem` if items of the kind do not have the requested part or layout."""
        if self.part is not None and self.part not in PARTS_OF.get(kind, ()):
            held = " or ".join(PARTS_OF.get(kind, ())) or "none"
            detail = (
                f"In the predecessor's format, an item of the kind {kind} has no file for the part {self.part!r}; "
                f"it has {held}."
            )
            raise InvalidProblem(detail, code="no-part")
        if self.layout is not None and self.layout not in LAYOUTS_OF.get(kind, ()):
            held = " or ".join(LAYOUTS_OF.get(kind, ())) or "none; leave it out"
            detail = (
                f"In the predecessor's format, an item of the kind {kind} has no layout {self.layout!r}; it has {held}."
            )
            raise InvalidProblem(detail, code="no-layout")


def unchanged_original(kind: Kind, parts: Parts, options: PredecessorOptions) -> StoredOriginal | None:
    """Return the file of Marey's predecessor from which an item was imported, or None if there is none.

    Also return None if the requested part was changed since the import, or if `options` set `layout`, `form` or
    `end_index`, because the imported file may be written in another way. The documents in `parts` may contain
    references to arrays in place of the arrays.
    """
    if options.layout is not None or options.form is not None or options.end_index is not None:
        return None
    if kind is Kind.GRAPH:
        return _if_unchanged("graph", parts["graph"], parts["graph"].get("original"))
    if kind is Kind.RECORD:
        return _if_unchanged("record", parts["record"], parts["record"]["original"])
    if kind is Kind.ANNOTATION:
        return _if_unchanged("annotation", parts["annotation"], parts["annotation"].get("original"))
    if kind is Kind.MODEL:
        origin = predecessor_origin(parts["model"])
        if options.part == "tree":
            return _if_unchanged("tree", parts.get("tree"), origin.tree)
        return _if_unchanged("model", parts["model"], origin.original)
    if kind is Kind.CLIP:
        source = parts.get("info", {}).get("source") or {}
        known = {"name": source.get("file_name", ""), "blob": source.get("file"), "content": source.get("content")}
        return _if_unchanged("motion", parts["motion"], known if known["content"] is not None else None)
    if kind is Kind.PROCESSED:
        files = parts["info"].get("predecessor") or {}
        if options.part == "alignment":
            return _if_unchanged("alignment", parts["info"], files.get("alignment"))
        return _if_unchanged("motion", parts["motion"], files.get("motion"))
    if kind is Kind.SKELETON:
        files = parts.get("mapping", {}).get("predecessor") or {}
        if options.part == "skeleton_model":
            return _if_unchanged("mapping", parts.get("mapping"), files.get("model"))
        return _if_unchanged("hierarchy", parts["hierarchy"], files.get("skeleton"))
    return None


def _if_unchanged(
    part: str, document: Mapping[str, Any] | None, known: StoredOriginal | Mapping[str, Any] | None
) -> StoredOriginal | None:
    if document is None or known is None:
        return None
    original = StoredOriginal.model_validate(known)
    return original if original.content == content_digest(part, document) else None


def write_predecessor(
    kind: Kind, name: str, parts: Parts, hierarchy: Mapping[str, Any] | None, options: PredecessorOptions
) -> tuple[str, bytes]:
    """Return the name and the bytes of a file in a format of Marey's predecessor.

    Raises `InvalidProblem` if the item cannot be written in such a format. Raises `NotFoundProblem` if a tree is
    requested of a model without a tree.
    """
    from marey_motion.errors import MotionError

    try:
        ending, data = _written(kind, name, parts, hierarchy, options)
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    return f"{name}{ending}", data


def _written(
    kind: Kind, name: str, parts: Parts, hierarchy: Mapping[str, Any] | None, options: PredecessorOptions
) -> tuple[str, bytes]:
    if kind is Kind.ANNOTATION:
        return "_sections.json", _annotation(parts["annotation"], options)
    if kind is Kind.GRAPH:
        return ".json", _graph(parts["graph"])
    if kind is Kind.RECORD:
        blob = parts["record"]["original"]["blob"]
        raise InvalidProblem(
            "The fields of this record were changed, so it is no longer the imported file. Export its first revision, "
            f"or download the blob {blob}.",
            code="cannot-be-exported",
        )
    if kind is Kind.SKELETON:
        return _skeleton(name, parts, options)
    if kind is Kind.PROCESSED:
        return "_alignment.json", _alignment(parts["info"])
    if kind is Kind.MODEL and hierarchy is not None:
        if options.part != "tree":
            return "_mm.json", _model(parts["model"], hierarchy, options)
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
    return write_predecessor_annotation(
        layer, form=options.form or DEFAULT_FORM, end_index=options.end_index or DEFAULT_END_INDEX
    )


def _alignment(part: Mapping[str, Any]) -> bytes:
    """Return the alignment file of Marey's predecessor: the time function, and the sections between keyframes.

    The time function gives the source frame at each canonical frame. Sections are ranges of canonical frames.
    """
    from marey_motion.formats.predecessor.alignment import write_predecessor_alignment

    info = AlignmentInfo.model_validate(part)
    bounds = sorted({0, *info.keyframes.values(), len(info.time_function)})
    return write_predecessor_alignment(info.time_function, list(pairwise(bounds)))


def _model(part: Mapping[str, Any], hierarchy: Mapping[str, Any], options: PredecessorOptions) -> bytes:
    """Return the file of a model in the layout that `options` name.

    Without a layout, use the one that can contain the model's time function exactly, or else layout 3.
    """
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
    is_flat = options.layout == "2" or (options.layout is None and known is not None and known.form == "increments")
    animated = predecessor_origin(part).animated_joints
    return write_predecessor_model(primitive, layout="2" if is_flat else "3", animated_joints=animated, time=time)


def _tree(model: Mapping[str, Any], part: Mapping[str, Any]) -> bytes:
    from marey_motion.formats.predecessor.tree import write_predecessor_tree
    from marey_motion.modelling.search.tree_documents import sample_tree_from_tree

    document = SampleTreeDocument.model_validate(part)
    tree = sample_tree_from_tree(document.model_dump())
    return write_predecessor_tree(tree, len(checked_model(model).spatial.directions), document.options.branching)


def _skeleton(name: str, parts: Parts, options: PredecessorOptions) -> tuple[str, bytes]:
    """Return the file of a skeleton, or of its skeleton model (joint mapping and axes) if `options` ask for it.

    Return the ending of the file's name, and its content. Raises `NotFoundProblem` if there is no joint mapping.
    """
    from marey_motion.documents import skeleton_from_document
    from marey_motion.formats.predecessor.encoding import encode_document
    from marey_motion.formats.predecessor.skeleton import skeleton_document

    model = _skeleton_model(parts["mapping"]) if "mapping" in parts else None
    if options.part == "skeleton_model":
        if model is None:
            raise NotFoundProblem(
                "The skeleton has no joint mapping to export; map its joints first, with `marey skeleton map`.",
                code="no-part",
            )
        return "_skeleton_model.json", encode_document({"name": name, "model": model}, "json")
    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(parts["hierarchy"]))
    form: SkeletonForm = "file" if options.layout == "file" else "database"
    data = encode_document(skeleton_document(skeleton, form=form, model=model), "json")
    return ".skeleton" if form == "file" else "_skeleton.json", data


def _skeleton_model(part: Mapping[str, Any]) -> dict[str, Any]:
    import numpy as np

    from marey_motion.formats.predecessor.skeleton_model import PredecessorSkeletonModel, skeleton_model_document

    mapping = SkeletonMapping.model_validate(part)
    swings = {joint: np.array(axes.swing) for joint, axes in mapping.axes.items()}
    twists = {joint: np.array(axes.twist) for joint, axes in mapping.axes.items()}
    rest = {} if mapping.predecessor is None else mapping.predecessor.rest
    return skeleton_model_document(PredecessorSkeletonModel(mapping.joints, swings, twists, rest))


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
