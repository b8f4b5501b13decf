"""Import of the predecessor's files that contain no motion: models, trees over samples of models, graphs, records.

The predecessor is the system that Marey replaces; `marey_motion.formats.predecessor` reads its files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.graph import graph_of_document
from marey_motion.formats.predecessor.model import PredecessorModel, model_of_document
from marey_motion.formats.predecessor.records import fields_of_record
from marey_motion.formats.predecessor.time_functions import PredecessorTime
from marey_motion.formats.predecessor.tree import read_predecessor_tree
from marey_motion.formats.texts import short_name
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
from marey_schemas.validation.reasons import first_reason

MOST_NAMED = 5
"""Greatest number of places in a file that a warning names."""
_NEEDED: dict[str, str] = {
    "notes": "an annotation or alignment must be imported together with its motion, and be called like it: for "
    "example, walk_sections.json needs walk.bvh or walk.bson.bz2; to annotate a clip that is already stored, use "
    "`marey annotation import`",
    "skeleton model": "a skeleton model must be imported together with its skeleton, and be called like it: for "
    "example, body_skeleton_model.json needs body_skeleton.json or body.skeleton",
}
"""Error message, by kind of content, for a file that was imported without the motion or skeleton that it belongs to."""


def import_document(file: FileToImport, source: SourceDocument) -> ImportedFile:
    """Import a model, with its cluster tree if the file has one as a companion; or import a graph or a record.

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
    if source.subject == "record":
        return _imported_record(file, source.document)
    given = None if file.skeleton is None else given_skeleton(file.skeleton)
    found = model_of_document(source.document, name, skeleton=given)
    own = found.primitive.skeleton
    if given is not None and not same_hierarchy(own, given, tolerance_m=SAME_OFFSET_M):
        message = "the model has a different skeleton from the chosen one; import it without choosing a skeleton"
        raise FormatError(message, code="skeleton-mismatch", file=name)
    ref = {"output": skeleton_output(name)} if file.skeleton is None else file.skeleton.ref
    item = main_item(file, Kind.MODEL, model_name(file.planned.item_name), _parts_of_file(file, found, ref))
    items = (item,) if given is not None else (skeleton_item(file, own), item)
    return ImportedFile(name, items, model_checks(found))


def _imported_record(file: FileToImport, document: Mapping[str, Any]) -> ImportedFile:
    """Make the item of a record; `document` has the members `form` (kind of record) and `content` (decoded file)."""
    fields = fields_of_record(document["content"])
    record: Tree = {
        "schema": "marey/predecessor-record@1",
        "form": document["form"],
        "fields": dict(fields.shown),
        "fields_left_out": fields.left_out,
    }
    record["original"] = original_of("record", record, file.planned.name, file.digest)
    item = main_item(file, Kind.RECORD, file.planned.item_name, {"record": record})
    checks: tuple[Tree, ...] = ()
    if fields.credentials:
        more = " and more" if len(fields.credentials) > MOST_NAMED else ""
        named = ", ".join(map(short_name, fields.credentials[:MOST_NAMED])) + more
        message = (
            f"the file contains credentials ({named}); they are not shown, but everybody who may read the project can "
            "download the file: revoke them, or remove them from the file before you import it"
        )
        checks = ({"code": "credentials-in-file", "message": message},)
    return ImportedFile(file.planned.name, (item,), checks)


def model_checks(found: PredecessorModel) -> tuple[Tree, ...]:
    """List the changes that the import made to a model.

    Parameters
    ----------
    found : PredecessorModel    the model that was read

    Returns
    -------
    tuple of dict    warnings, as documents
    """
    if not found.moved_keyframes:
        return ()
    more = f" and {len(found.moved_keyframes) - MOST_NAMED} more" if len(found.moved_keyframes) > MOST_NAMED else ""
    labels = ", ".join(map(short_name, found.moved_keyframes[:MOST_NAMED])) + more
    last = found.primitive.frame_count - 1
    message = (
        f"the file places these keyframes after the last frame, so the import moved them to frame {last}: {labels}"
    )
    return ({"code": "keyframes-at-end", "message": message},)


def _parts_of_file(file: FileToImport, found: PredecessorModel, skeleton: Tree) -> dict[str, Tree]:
    """Make the documents of a model that was read from `file`; the companion of the file may be the model's tree."""
    name, companion = file.planned.name, str(file.planned.companion)
    beside = None if file.companion is None or is_skeleton_name(companion) else bytes(file.companion)
    tree = None if beside is None else (beside, companion)
    parts = model_parts(found, model_name(file.planned.item_name), skeleton, name, tree)
    known = parts["model"]["provenance"]["predecessor"]
    known["original"] = original_of("model", parts["model"], name, file.digest)
    if "tree" in parts and file.companion_digest is not None:
        known["tree"] = original_of("tree", parts["tree"], companion, file.companion_digest)
    return parts


def model_parts(
    found: PredecessorModel, name: str, skeleton: Tree, file: str, tree: tuple[bytes, str] | None
) -> dict[str, Tree]:
    """Make the documents of a model.

    Parameters
    ----------
    found : PredecessorModel    the model that was read
    name : str    its name, if the document does not contain one
    skeleton : dict    reference to its skeleton
    file : str    name of its file, for messages
    tree : (bytes, str), optional    content and name of the file with its tree

    Returns
    -------
    dict of str to dict    `model` and, if there is a tree, `tree`

    Raises
    ------
    FormatError    if the tree is invalid, or does not fit the model
    """
    model = primitive_to_tree(replace(found.primitive, name=found.primitive.name or name), skeleton)
    known: Tree = {
        "layout": found.layout,
        "animated_joints": list(found.animated_joints),
        "time_form": None if found.time is None else found.time.form,
        "time_error_frames": found.time_error_frames,
        "time": None if found.time is None else _time(found.time, model),
    }
    model["provenance"] = {"predecessor": known}
    if tree is None:
        return {"model": model}
    return {"model": model, "tree": _imported_tree(*tree, file, found.primitive)}


def _time(time: PredecessorTime, model: Tree) -> Tree:
    """Convert a time function of the predecessor to plain values.

    The value `content` is the digest of the time function in the document `model`, which was converted from `time`.
    """
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
        message = f"the samples of the tree have {tree.dimensions} numbers, but {model}; use the tree of this model"
        raise FormatError(message, code="tree-of-another-model", file=name)
    try:
        options = TreeOptions(
            samples=len(tree.samples),
            branching=max(2, int(tree.children.max())),
            leaf_size=int(tree.sizes[tree.children == 0].max()),
            features="latent",
        )
    except ValidationError as error:
        raise FormatError(f"the tree is too large: {first_reason(error)}", code="tree-options", file=name) from error
    return sample_tree_to_tree(tree, model_digest=PartDigestRef(digest_of="model"), seed=0, options=options)
