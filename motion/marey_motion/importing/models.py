"""Import of the predecessor's files that contain no motion: models, trees over samples of models, and graphs.

The predecessor is the system that Marey replaces; `marey_motion.formats.predecessor` reads its files.
"""

from __future__ import annotations

from dataclasses import replace

from pydantic import ValidationError

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.graph import graph_of_document
from marey_motion.formats.predecessor.model import PredecessorModel, model_of_document
from marey_motion.formats.predecessor.time_functions import PredecessorTime
from marey_motion.formats.predecessor.tree import read_predecessor_tree
from marey_motion.importing.items import (
    FileToImport,
    ImportedFile,
    ImportedGraph,
    Tree,
    given_skeleton,
    main_item,
    skeleton_item,
)
from marey_motion.importing.source import SourceDocument
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_motion.skeleton import SAME_OFFSET_M, same_hierarchy
from marey_schemas.documents.originals import content_digest, original_of
from marey_schemas.documents.references import PartDigestRef
from marey_schemas.formats.companions import is_skeleton_name, model_name
from marey_schemas.imports import skeleton_output
from marey_schemas.kinds import Kind
from marey_schemas.options.modelling import TreeOptions

_NEEDED: dict[str, str] = {
    "notes": "an annotation or alignment must be imported together with its motion, and be called like it: for "
    "example, walk_sections.json needs walk.bvh or walk.bson.bz2; to annotate a clip that is already stored, use "
    "`marey annotation import`",
    "skeleton model": "a skeleton model must be imported together with its skeleton, and be called like it: for "
    "example, body_skeleton_model.json needs body_skeleton.json or body.skeleton",
}
"""What to do with files that are only read together with others, by subject."""


def import_document(file: FileToImport, source: SourceDocument) -> ImportedFile:
    """Import a model, with its cluster tree if the file has one as a companion; or import a graph.

    Parameters
    ----------
    file : FileToImport    the file
    source : SourceDocument    its decoded content

    Returns
    -------
    ImportedFile    items, or the graph

    Raises
    ------
    FormatError    if the file is invalid
    """
    name = file.planned.name
    if source.subject == "tree":
        message = "a tree over samples of a model must be imported together with the file of that model"
        example = "for example, walk_cluster_tree.json needs walk_mm.json"
        raise FormatError(f"{message}; {example}", code="model-missing", file=name)
    if source.subject in _NEEDED:
        raise FormatError(_NEEDED[source.subject], code="companion-of-nothing", file=name)
    if source.subject == "graph":
        read = graph_of_document(source.document, name)
        graph = ImportedGraph(file.planned.item_name, file.collection, file.options.tags, read, name, file.digest)
        return ImportedFile(name, graph=graph)
    given = None if file.skeleton is None else given_skeleton(file.skeleton)
    found = model_of_document(source.document, name, skeleton=given)
    own = found.primitive.skeleton
    if given is not None and not same_hierarchy(own, given, tolerance_m=SAME_OFFSET_M):
        message = "the model has a different skeleton from the chosen one; import it without choosing a skeleton"
        raise FormatError(message, code="skeleton-mismatch", file=name)
    ref = {"output": skeleton_output(name)} if file.skeleton is None else file.skeleton.ref
    item = main_item(file, Kind.MODEL, model_name(file.planned.item_name), _parts(file, found, ref))
    items = (item,) if given is not None else (skeleton_item(file, own), item)
    return ImportedFile(name, items, _checks(found))


def _checks(found: PredecessorModel) -> tuple[Tree, ...]:
    """List what was changed in a model, as documents."""
    if not found.moved_keyframes:
        return ()
    labels, last = ", ".join(found.moved_keyframes), found.primitive.frame_count - 1
    message = f"the file places these keyframes at the end of the motion, after its last frame {last}: {labels}"
    return ({"code": "keyframes-at-end", "message": message},)


def _parts(file: FileToImport, found: PredecessorModel, skeleton: Tree) -> dict[str, Tree]:
    """Make the documents `model` and, if the companion of the file is a tree, `tree`."""
    name = found.primitive.name or model_name(file.planned.item_name)
    model = primitive_to_tree(replace(found.primitive, name=name), skeleton)
    known: Tree = {
        "layout": found.layout,
        "animated_joints": list(found.animated_joints),
        "time_form": None if found.time is None else found.time.form,
        "time_error_frames": found.time_error_frames,
        "original": original_of("model", model, file.planned.name, file.digest),
        "time": None if found.time is None else _time(found.time, model),
    }
    parts = {"model": model}
    companion = str(file.planned.companion)
    if file.companion is not None and file.companion_digest is not None and not is_skeleton_name(companion):
        parts["tree"] = _imported_tree(bytes(file.companion), companion, file.planned.name, found.primitive)
        known["tree"] = original_of("tree", parts["tree"], companion, file.companion_digest)
    model["provenance"] = {"predecessor": known}
    return parts


def _time(time: PredecessorTime, model: Tree) -> Tree:
    """Make the record of the time function of a file, from which the one in the document `model` was converted."""
    return {
        "form": time.form,
        "knots": time.basis.knots,
        "degree": time.basis.degree,
        "mean": time.mean,
        "eigen": time.directions,
        "content": content_digest("time", model),
    }


def _imported_tree(data: bytes, name: str, model_file: str, primitive: MotionPrimitive) -> Tree:
    """Make the document `tree`; seed and features of an imported tree are unknown, so defaults are written."""
    tree = read_predecessor_tree(data, name)
    if tree.dimensions != primitive.dimensions:
        model = f"the latent vectors of {model_file} have {primitive.dimensions}"
        message = f"the samples of the tree have {tree.dimensions} numbers, but {model}"
        raise FormatError(message, code="tree-of-another-model", file=name)
    try:
        options = TreeOptions(
            samples=len(tree.samples),
            branching=max(2, int(tree.children.max())),
            leaf_size=int(tree.sizes[tree.children == 0].max()),
            features="latent",
        )
    except ValidationError as error:
        raise FormatError(f"the tree is too large: {error}", code="tree-options", file=name) from error
    return sample_tree_to_tree(tree, model_digest=PartDigestRef(digest_of="model"), seed=0, options=options)
