"""Import of joint mappings, axes, annotations and alignments from files of the predecessor.

A skeleton may have a skeleton model (joint mapping and axes). A motion may have notes: an annotation, or an alignment,
with which the motion becomes an aligned clip. The predecessor is the system that Marey replaces.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from marey_motion.documents import layer_to_document
from marey_motion.editing.annotations.layers import Layer
from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.alignment import TIME_FUNCTION, alignment_of_document, as_increasing
from marey_motion.formats.predecessor.annotation import layers_of_document
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.skeleton import FORMAT
from marey_motion.formats.predecessor.skeleton_model import (
    PredecessorSkeletonModel,
    across,
    is_skeleton_model,
    skeleton_model_of_document,
)
from marey_motion.importing.anatomy import anatomy_of
from marey_motion.importing.items import FileToImport, ImportedItem, Tree, main_item, skeleton_item
from marey_motion.importing.source import ImportedMotion
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.originals import content_digest, original_of
from marey_schemas.documents.references import OutputRef
from marey_schemas.imports import notes_output
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH

IMPORTED_LAYER = "imported"


def described_skeleton(file: FileToImport, skeleton: Skeleton) -> ImportedItem:
    """Make the item of a skeleton that was imported from a skeleton file, including the joint mapping.

    Parameters
    ----------
    file : FileToImport    the file; its companion, if it has one, is a skeleton model
    skeleton : Skeleton    its joints

    Returns
    -------
    ImportedItem    item with the documents `hierarchy` and `mapping`

    Raises
    ------
    FormatError    if the skeleton model does not fit the skeleton
    """
    item = skeleton_item(file, skeleton)
    mapping = dict(anatomy_of(skeleton).mapping_part)  # a copy: equal skeletons share the document
    name, companion = file.planned.name, file.planned.companion
    own = decode_document(bytes(file.data), name)
    document, place = own.get("skeleton_model"), name
    if file.companion is not None and companion is not None:
        document, place = decode_document(bytes(file.companion), companion), companion
    original: Tree = {"skeleton": original_of("hierarchy", item.parts["hierarchy"], name, file.digest)}
    if isinstance(document, Mapping) and is_skeleton_model(document):
        model = skeleton_model_of_document(document, skeleton, place)
        mapping |= _mapping_of(model, mapping)
        original["rest"] = _as_json(model.rest, place)
        if place != name and file.companion_digest is not None:
            original["model"] = original_of("mapping", mapping, place, file.companion_digest)
    elif place != name:
        raise FormatError(
            "the file is named like a skeleton model, but is none: a skeleton model has an object 'joints', and none "
            "of the fields 'root', 'jointDescs' and 'sspm'; correct the file, or import the skeleton without it",
            code="document-unknown",
            file=place,
        )
    return replace(item, parts={**item.parts, "mapping": {**mapping, "predecessor": original}})


def _as_json(rest: Mapping[str, Any], file: str) -> Tree:
    """Convert members of a skeleton model to JSON types; raise `FormatError` for BSON values that JSON lacks."""
    kept: Tree = {}
    for name, value in rest.items():
        try:
            kept[name] = json.loads(json.dumps(value, allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            raise FormatError(
                f"the field {name!r} of the skeleton model has a value that JSON cannot represent ({error}); remove "
                "the field, or store the value as text or as finite numbers",
                file=file,
            ) from error
    return kept


def _mapping_of(model: PredecessorSkeletonModel, guessed: Tree) -> Tree:
    """Return the members of a document `mapping` that replace those guessed from the skeleton.

    The model may contain only one of the two axes of a joint (twist and swing). The other axis is then the component
    of the guessed axis that is perpendicular to the axis in the model.
    """
    axes: dict[str, Tree] = dict(guessed["axes"])
    for joint in {**model.twists, **model.swings}:
        near = {name: np.array(direction) for name, direction in axes.get(joint, {}).items()}
        swing, twist = model.swings.get(joint, near.get("swing")), model.twists.get(joint)
        if twist is None:
            assert swing is not None
            twist = across(near.get("twist"), swing)
        axes[joint] = {"twist": twist.tolist(), "swing": across(swing, twist).tolist()}
    notes = ["joints and axes from a skeleton model of the predecessor"]
    return {"method": "manual", "confidence": 1.0, "joints": dict(model.joints), "axes": axes, "notes": notes}


def noted_items(file: FileToImport, imported: ImportedMotion, motion: Tree, clip: ImportedItem) -> list[ImportedItem]:
    """Make the items of a motion with notes: the clip with annotations, or an aligned clip in place of the clip.

    Parameters
    ----------
    file : FileToImport    the file, with notes
    imported : ImportedMotion    its motion
    motion : dict    document `motion` of the clip
    clip : ImportedItem    the clip

    Returns
    -------
    list of ImportedItem    one or several items

    Raises
    ------
    FormatError    if the notes do not fit the motion
    """
    assert imported.clip is not None
    assert file.notes is not None
    assert file.planned.notes is not None
    assert file.notes_digest is not None
    name = file.planned.notes
    document = decode_document(bytes(file.notes), name)
    if TIME_FUNCTION in document:
        return [_aligned_item(file, document, motion, imported)]
    layers = layers_of_document(document, name, imported.clip.frame_count, end_index=file.options.end_index)
    return [clip, *(_annotation(file, name, layer, label) for label, layer in layers.items())]


def _annotation(file: FileToImport, notes: str, layer: Layer, label: str | None) -> ImportedItem:
    """Make the item of an annotation; `label` is the only label in `layer`, or None if `layer` has all labels."""
    ref = OutputRef(output=file.planned.name)
    named = IMPORTED_LAYER if label is None else label
    part = layer_to_document(layer, ref, named).model_dump(mode="json", by_alias=True, exclude_none=True)
    part["original"] = original_of("annotation", part, notes, str(file.notes_digest))
    item_name = f"{file.planned.item_name} {named.replace('/', '_')}"[:MAX_NAME_LENGTH]
    item = main_item(file, Kind.ANNOTATION, item_name, {"annotation": part})
    return replace(item, name=notes_output(file.planned.name, named), tags=())


def _aligned_item(
    file: FileToImport, document: Mapping[str, Any], motion: Tree, imported: ImportedMotion
) -> ImportedItem:
    """Make the item of an aligned clip; the number of frames of the source clip is taken from the time function."""
    name = str(file.planned.notes)
    found = alignment_of_document(document, name)
    if len(found.frames) != len(motion["poses"]):
        message = (
            f"the time function has {len(found.frames)} canonical frames, but the clip {len(motion['poses'])}; import "
            "the clip with its own alignment"
        )
        raise FormatError(message, code="time-function-invalid", file=name)
    source_frames = int(found.frames.max()) + 1
    ends = [end for _, end in found.sections if end < len(found.frames)]
    info: Tree = {
        "schema": "marey/alignment@1",
        "name": file.planned.item_name,
        "subject": file.options.subject,
        "frame_rate_hz": motion["frame_rate_hz"],
        "source_frames": source_frames,
        "time_function": as_increasing(found.frames, source_frames),
        "keyframes": {f"contact{number}": end for number, end in enumerate(ends)},
    }
    info = {key: value for key, value in info.items() if value is not None}
    origin = {"alignment": original_of("alignment", info, name, str(file.notes_digest))}
    if motion_content(file, imported, motion) is not None:
        origin["motion"] = original_of("motion", motion, file.planned.name, file.digest)
    info["predecessor"] = origin
    AlignmentInfo.model_validate(info)
    return main_item(file, Kind.PROCESSED, file.planned.item_name, {"motion": motion, "info": info})


def motion_content(file: FileToImport, imported: ImportedMotion, motion: Tree) -> str | None:
    """Return the digest of a motion that was imported unchanged from a file of the predecessor.

    Parameters
    ----------
    file : FileToImport    the file
    imported : ImportedMotion    its motion
    motion : dict    document `motion` of the clip

    Returns
    -------
    str or None    the digest; None if the file has another format, if the import dropped frames or moved the floor, or
        if the options set the unit, the upward axis, left-handed axes or the frame rate
    """
    options, source = file.options, imported.source
    unchanged = source.format == FORMAT and source.trimmed_frames == (0, 0) and source.floor_shift_m == 0.0
    given = options.frame_rate_hz or options.metres_per_unit or options.up_axis or options.handedness != "right"
    return content_digest("motion", motion) if unchanged and not given else None
