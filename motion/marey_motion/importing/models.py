"""From files of the predecessor that hold no motion to documents: models with trees over their samples, and graphs."""

from __future__ import annotations

from dataclasses import replace

from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.documents import model_name
from marey_motion.formats.predecessor.graph import graph_of_document
from marey_motion.formats.predecessor.model import model_of_document
from marey_motion.formats.predecessor.tree import read_predecessor_tree
from marey_motion.importing.files import (
    SAME_OFFSET_M,
    SKELETON_OUTPUT,
    FileDigests,
    ImportedDocuments,
    ImportRequest,
    ModelledDocuments,
    Tree,
    anatomy_of,
    as_tree,
)
from marey_motion.importing.plan import PlannedFile
from marey_motion.importing.source import SourceDocument
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.search.tree import TreeOptions
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_motion.skeleton import same_hierarchy
from marey_schemas.documents.originals import original_of
from marey_schemas.documents.references import PartDigestRef


def import_modelled(
    planned: PlannedFile,
    source: SourceDocument,
    request: ImportRequest,
    digests: FileDigests,
    tree: bytes | None,
) -> ImportedDocuments:
    """Convert a file of the predecessor that holds no motion: a model with its tree, or a graph.

    Parameters
    ----------
    planned : PlannedFile    plan of the file
    source : SourceDocument    the decoded file
    request : ImportRequest    facts given by the user
    digests : FileDigests    digests of the file and its companion
    tree : bytes or None    content of the file with the tree over the model's samples

    Returns
    -------
    ImportedDocuments    documents of the model and its skeleton, or the graph

    Raises
    ------
    FormatError    where the file is wrong
    """
    file = planned.name
    if source.subject == "tree":
        message = "a tree over samples of a model; import it together with its model, named alike, as in walk_mm.json"
        raise FormatError(f"{message} and walk_cluster_tree.json", code="model-missing", file=file)
    if source.subject == "graph":
        graph = ModelledDocuments(planned.item_name, graph=graph_of_document(source.document, file))
        return ImportedDocuments("", None, None, None, None, (), graph)
    found = model_of_document(source.document, file, skeleton=request.skeleton)
    skeleton = found.primitive.skeleton
    given = request.skeleton is not None
    if request.skeleton is not None and not same_hierarchy(skeleton, request.skeleton, tolerance_m=SAME_OFFSET_M):
        message = "its skeleton is not the one asked for; leave that out, and it is imported with its own"
        raise FormatError(message, code="skeleton-mismatch", file=file)
    name = model_name(planned.item_name)
    ref = dict(request.skeleton_ref or {}) if given else {"output": SKELETON_OUTPUT}
    model = primitive_to_tree(replace(found.primitive, name=found.primitive.name or name), ref)
    known: Tree = {
        "layout": found.layout,
        "animated_joints": list(found.animated_joints),
        "time_form": found.time_form,
        "time_error_frames": found.time_error_frames,
        "original": original_of("model", model, file, digests.file),
    }
    parts = {"model": model}
    if tree is not None and digests.companion is not None:
        parts["tree"] = _imported_tree(tree, planned, found.primitive)
        known["tree"] = original_of("tree", parts["tree"], str(planned.companion), digests.companion)
    model["provenance"] = {"predecessor": known}
    modelled = ModelledDocuments(name, parts)
    if given:
        return ImportedDocuments("", None, None, None, None, (), modelled)
    mapping, axes = anatomy_of(skeleton, None)
    hierarchy, joints = as_tree(skeleton_to_document(skeleton)), as_tree(mapping_to_document(mapping, axes))
    return ImportedDocuments(mapping.rig or "skeleton", hierarchy, joints, None, None, (), modelled)


def _imported_tree(data: bytes, planned: PlannedFile, primitive: MotionPrimitive) -> Tree:
    """Part `tree`; seed and features are not known of a tree that was made elsewhere."""
    file = str(planned.companion)
    tree = read_predecessor_tree(data, file)
    if tree.dimensions != primitive.dimensions:
        message = f"its samples have {tree.dimensions} numbers, those of {planned.name} {primitive.dimensions}"
        raise FormatError(message, code="tree-of-another-model", file=file)
    options = TreeOptions(
        samples=len(tree.samples),
        branching=max(2, int(tree.children.max())),
        leaf_size=int(tree.sizes[tree.children == 0].max()),
        features="latent",
    )
    return sample_tree_to_tree(tree, model_digest=PartDigestRef(digest_of="model"), seed=0, options=options)
