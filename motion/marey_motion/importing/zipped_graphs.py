"""Import of zipped graphs of the predecessor: a skeleton, models with their trees, and the graph over them.

The models are stored in a folder with the name of the archive, as if it had been unpacked, so that they are not mixed
up with models of the same names. Each model is called `<action>_<primitive>`, as in the predecessor's database.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from marey_motion.errors import FormatError
from marey_motion.formats.bvh import read_bvh
from marey_motion.formats.conversion import convert
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.model import PredecessorModel, model_of_document
from marey_motion.formats.predecessor.sections import LAST_FRAME
from marey_motion.formats.predecessor.skeleton import read_skeleton_document
from marey_motion.formats.predecessor.zipped_graph import ZippedGraph, ZippedModel, read_zipped_graph
from marey_motion.formats.texts import short_name
from marey_motion.importing.items import (
    FileToImport,
    ImportedFile,
    ImportedGraph,
    ImportedItem,
    Tree,
    given_skeleton,
    skeleton_item,
)
from marey_motion.importing.models import MOST_NAMED, model_checks, model_parts
from marey_motion.importing.predecessor import described_skeleton
from marey_motion.skeleton import SAME_OFFSET_M, Skeleton, same_hierarchy
from marey_schemas.imports import skeleton_output
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions

_CENTIMETRES = ImportOptions(unit="cm", up_axis="y")
_ENDS = ("-1", "lastFrame", LAST_FRAME)
_MIDDLE = "middle"


def import_zipped_graph(file: FileToImport) -> ImportedFile:
    """Import a zipped graph.

    Parameters
    ----------
    file : FileToImport    the file

    Returns
    -------
    ImportedFile    skeleton and models, and the graph

    Raises
    ------
    FormatError    if the archive or a member is invalid, or if a model has another skeleton than the archive
    """
    name = file.planned.name
    found = read_zipped_graph(bytes(file.data), name)
    folder = "/".join(part for part in (file.planned.folder, file.planned.item_name) if part)
    file = replace(file, planned=replace(file.planned, folder=folder))
    skeleton = _skeleton(found, name) if file.skeleton is None else given_skeleton(file.skeleton)
    ref: Tree = {"output": skeleton_output(name)} if file.skeleton is None else file.skeleton.ref
    items: list[ImportedItem] = [] if file.skeleton is not None else [_skeleton_item(file, found, skeleton)]
    checks = _checks(found)
    for model in found.models:
        read = _read_model(model, skeleton, f"{name}: {model.member}")
        items.append(_model_item(file, model, read, ref))
        checks += model_checks(read)
    graph = ImportedGraph(file.planned.item_name, file.collection, file.options.tags, found.graph, name, file.digest)
    return ImportedFile(name, tuple(items), tuple(checks), graph=graph)


def _checks(found: ZippedGraph) -> list[Tree]:
    checks: list[Tree] = []
    pickles = "these trees are pickles, which are programs and never read; build them again with `marey tree`"
    strays = "these transitions lead from or to nodes that do not exist, and are left out"
    for code, what, names in (
        ("tree-pickled", pickles, found.pickled),
        ("transitions-ignored", strays, found.unknown),
    ):
        if names:
            more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
            checks.append({"code": code, "message": f"{what}: {', '.join(names[:MOST_NAMED])}{more}"})
    return checks


def _skeleton(found: ZippedGraph, file: str) -> Skeleton:
    member = f"{file}: {found.skeleton_member}"
    if found.skeleton_member.endswith(".bvh"):
        return convert(read_bvh(found.skeleton, member), member, _CENTIMETRES).skeleton
    document = decode_document(found.skeleton, member)
    return convert(read_skeleton_document(document, member), member, ImportOptions()).skeleton


def _skeleton_item(file: FileToImport, found: ZippedGraph, skeleton: Skeleton) -> ImportedItem:
    """Make the item of the skeleton, without a reference to an original file: the archive also contains models."""
    if found.skeleton_member.endswith(".bvh"):
        return skeleton_item(file, skeleton)
    item = described_skeleton(replace(file, data=found.skeleton, companion=None), skeleton)
    origin = {"rest": item.parts["mapping"]["predecessor"].get("rest", {})}
    return replace(item, parts={**item.parts, "mapping": {**item.parts["mapping"], "predecessor": origin}})


def _read_model(model: ZippedModel, skeleton: Skeleton, member: str) -> PredecessorModel:
    found = model_of_document(decode_document(model.data, member), member, skeleton=skeleton)
    own = found.primitive.skeleton
    if not same_hierarchy(own, skeleton, tolerance_m=SAME_OFFSET_M):
        message = "the skeletons of the model and of the graph differ; unpack the archive, and import the files in it"
        raise FormatError(message, code="skeleton-mismatch", file=member)
    frames = found.primitive.frame_count
    listed = dict(_keyframes(model.keyframes, frames, member))
    return replace(found, primitive=replace(found.primitive, keyframes={**listed, **found.primitive.keyframes}))


def _keyframes(given: Mapping[str, Any], frames: int, member: str) -> Iterator[tuple[str, int]]:
    """Yield label and frame of each keyframe that the archive lists for a model.

    Frames outside the motion become its first or last frame.
    """
    for label, frame in given.items():
        if frame in _ENDS:
            yield label, frames - 1
        elif frame == _MIDDLE:
            yield label, frames // 2
        else:
            try:
                number = int(frame)
            except (TypeError, ValueError) as error:
                message = (
                    f"keyframe {short_name(label)!r} must be the number of a frame, 'lastFrame' or 'middle', not "
                    f"{short_name(frame)!r}"
                )
                raise FormatError(message, file=member) from error
            yield label, min(max(number, 0), frames - 1)


def _model_item(file: FileToImport, model: ZippedModel, read: PredecessorModel, skeleton: Tree) -> ImportedItem:
    """Make the item of a model; if the project has a model of this name, the item becomes its new revision.

    This also applies to a model with another skeleton, because the graph needs the imported model.
    """
    tree = None if model.tree is None or model.tree_member is None else (model.tree, model.tree_member)
    parts = model_parts(read, model.name, skeleton, model.member, tree)
    name = f"{file.planned.name}#{model.name}"
    return ImportedItem(name, Kind.MODEL, model.name, file.collection, parts, file.options.tags)
