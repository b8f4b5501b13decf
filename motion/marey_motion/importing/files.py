"""Import of one file: conversion of its bytes, with the user's options, to items with documents.

All callers import files through `import_file`, which can run in a separate process: it needs no files, network or
database, and takes and returns only plain values, bytes and arrays. Its results do not depend on earlier calls.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np
from pydantic import ValidationError

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_tree, skeleton_from_document
from marey_motion.errors import AmbiguousUnits, FormatError, MotionError
from marey_motion.formats import read_source
from marey_motion.formats.conversion import convert
from marey_motion.formats.predecessor.skeleton import FORMAT as PREDECESSOR
from marey_motion.formats.texts import cut_text, short_name
from marey_motion.importing.anatomy import anatomy_of
from marey_motion.importing.items import (
    FileToImport,
    ImportedFile,
    ImportedItem,
    Tree,
    given_skeleton,
    main_item,
    skeleton_item,
)
from marey_motion.importing.plan import PlannedFile
from marey_motion.importing.predecessor import described_skeleton, motion_content, noted_items
from marey_motion.importing.siblings import AxisFinding
from marey_motion.importing.source import ImportedMotion, SourceDocument
from marey_motion.skeleton import SAME_OFFSET_M, Skeleton
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.imports import ImportEntry, Refusal, refused_entry, skeleton_output
from marey_schemas.kinds import Kind
from marey_schemas.names import base_name
from marey_schemas.validation.reasons import first_reason

_LONGEST_COLLECTION = 1024
_LONGEST_MESSAGE = 4000


def planned_entry(planned: PlannedFile) -> ImportEntry | None:
    """Make the result entry of a file that is not read on its own, because it is a companion or refused by the plan.

    Parameters
    ----------
    planned : PlannedFile    the plan

    Returns
    -------
    ImportEntry or None    None if the file is to be read
    """
    if planned.role == "companion":
        return ImportEntry(name=planned.name, status="companion")
    if planned.role == "refused":
        return refused_entry(planned.name, Refusal(code=planned.code, detail=f"{planned.name}: {planned.reason}"))
    return None


def import_file(file: FileToImport) -> ImportedFile:
    """Read one file and make the documents of its items; a defective file gives a refusal, not an exception.

    Parameters
    ----------
    file : FileToImport    bytes, plan and options; its plan's role is `motion` or `skeleton`

    Returns
    -------
    ImportedFile    items with their documents, in metres, right-handed, Y up; or the refusal
    """
    try:
        if len(file.collection) > _LONGEST_COLLECTION:
            raise FormatError(
                f"the path of the file's collection is longer than {_LONGEST_COLLECTION} characters; shorten the path",
                code="name-invalid",
            )
        return _storable(_imported(file))
    except MotionError as error:
        return ImportedFile(file.planned.name, refusal=refusal_of(error))
    except (OverflowError, UnicodeError, ValidationError) as error:  # of a value that no document may contain
        first = first_reason(error) if isinstance(error, ValidationError) else str(error)
        refused = FormatError(f"the file contains a value that cannot be stored: {first}", code="value-range")
        return ImportedFile(file.planned.name, refusal=refusal_of(refused))


def refusal_of(error: MotionError) -> Refusal:
    """Convert the error that stopped the import of a file to a refusal, with line and joint if they are known.

    Parameters
    ----------
    error : MotionError    reason of the refusal

    Returns
    -------
    Refusal    code and text
    """
    line, joint = getattr(error, "line", None), getattr(error, "joint", None)
    detail = cut_text(str(error), _LONGEST_MESSAGE)
    return Refusal(code=error.code, detail=detail, line=line, joint=None if joint is None else short_name(joint))


def _storable(found: ImportedFile) -> ImportedFile:
    """Shorten the messages of an import, and replace characters in them that UTF-8 cannot encode.

    Raises `UnicodeError` if the graph contains a name that UTF-8 cannot encode.
    """
    if found.graph is not None:
        for (action, name), node in found.graph.graph.nodes.items():
            "".join((action, name, node.model_id, *chain(*node.transitions))).encode()
    checks = tuple({**check, "message": cut_text(check["message"], _LONGEST_MESSAGE)} for check in found.checks)
    return replace(found, checks=checks)


def _imported(file: FileToImport) -> ImportedFile:
    source = read_source(
        file.data,
        file.planned.name,
        companion=file.companion,
        companion_name=file.planned.companion or "the companion",
        options=file.options,
        skeleton=None if file.skeleton is None else given_skeleton(file.skeleton),
    )
    if isinstance(source, SourceDocument):
        return _imported_document(file, source)
    is_inferred = file.options.up_axis is None and source.up_axis is None
    try:
        imported = convert(source, file.planned.name, file.options, file.sibling_axis)
    except AmbiguousUnits as error:
        is_axis = is_inferred and error.code == "up-axis-ambiguous"
        axis = AxisFinding(source.rig_digest, None, False) if is_axis else None
        return ImportedFile(file.planned.name, refusal=refusal_of(error), axis=axis)
    axis = AxisFinding(source.rig_digest, imported.source.up_axis, imported.axis_is_clear) if is_inferred else None
    checks = tuple(_check_document(warning.as_dict()) for warning in imported.warnings)
    items: list[ImportedItem] = []
    reference = {"output": skeleton_output(file.planned.name)}
    if file.skeleton is not None and imported.clip is not None:
        imported = _on_skeleton(imported, imported.clip, given_skeleton(file.skeleton), file.planned.name)
        reference = file.skeleton.ref
    elif imported.clip is None and imported.source.format == PREDECESSOR:
        items.append(described_skeleton(file, imported.skeleton))
    else:
        items.append(skeleton_item(file, imported.skeleton))
    if (clip := imported.clip) is not None:
        motion = clip_to_tree(clip, reference)
        parts = {"motion": motion, "info": _info(imported, file, checks, motion)}
        item = main_item(file, Kind.CLIP, file.planned.item_name, parts)
        items += [item] if file.notes is None else noted_items(file, imported, motion, item)
    frames = None if clip is None else clip.frame_count
    return ImportedFile(file.planned.name, tuple(items), checks, frames, axis=axis)


def _imported_document(file: FileToImport, source: SourceDocument) -> ImportedFile:
    """Import a file without motion; the modules that read models are loaded only for such files."""
    if source.subject == "zipped graph":
        from marey_motion.importing.zipped_graphs import import_zipped_graph

        return import_zipped_graph(file)
    from marey_motion.importing.models import import_document

    return import_document(file, source)


def mapping_part(hierarchy: Tree) -> Tree:
    """Make the document `mapping` of a skeleton, with the axes of its joints.

    `import_file` leaves this document out: it takes long, and only a skeleton that is new to the project needs it.

    Parameters
    ----------
    hierarchy : dict    document `hierarchy` of the skeleton, as plain values

    Returns
    -------
    dict    the document, as plain values
    """
    return anatomy_of(skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))).mapping_part


def _check_document(warning: Tree) -> Tree:
    return {key: value for key, value in warning.items() if value is not None}


def _info(imported: ImportedMotion, file: FileToImport, checks: tuple[Tree, ...], motion: Tree) -> Tree:
    details = {key: value for key, value in imported.source.as_dict().items() if key not in ("format", "file")}
    companion = file.planned.companion
    source = {
        "file": file.digest,
        "file_name": base_name(file.planned.name),
        "companion": file.companion_digest,
        "companion_name": None if companion is None else base_name(companion),
        "content": motion_content(file, imported, motion),
        "format": imported.source.format,
        "details": details,
    }
    info = {
        "schema": "marey/clip-info@1",
        "subject": file.options.subject,
        "capture_system": file.options.capture_system,
        "licence": file.options.licence,
        "source": {key: value for key, value in source.items() if value is not None},
        "checks": list(checks),
    }
    return {key: value for key, value in info.items() if value is not None}


def _require_same_parents(own: Skeleton, chosen: Skeleton, file: str) -> None:
    """Raise `FormatError` if a joint has different parents in the file's skeleton and in the chosen one."""
    for name in chosen.joint_names:
        here, there = (_place_of(name, skeleton) for skeleton in (own, chosen))
        if here != there:
            raise FormatError(
                f"in the file, the joint {name} {here}, but in the chosen skeleton, it {there}; import without "
                "choosing a skeleton, then retarget",
                code="skeleton-mismatch",
                file=file,
                joint=name,
            )


def _place_of(name: str, skeleton: Skeleton) -> str:
    parent = skeleton.parents[skeleton.index_of(name)]
    return "is the root" if parent < 0 else f"is below {skeleton.joint_names[parent]}"


def _on_skeleton(imported: ImportedMotion, clip: Clip, skeleton: Skeleton, file: str) -> ImportedMotion:
    """Convert a clip to a given skeleton, which must equal the file's skeleton except in the order of joints.

    The channels in the record of the import get the order of the given skeleton, too.
    """
    own = clip.skeleton
    if set(own.joint_names) != set(skeleton.joint_names):
        odd = ", ".join(sorted(set(own.joint_names) ^ set(skeleton.joint_names))[:5])
        raise FormatError(
            f"the joints of the file differ from those of the chosen skeleton ({odd}); import without "
            "choosing a skeleton, then retarget",
            code="skeleton-mismatch",
            file=file,
        )
    order = np.array([own.index_of(name) for name in skeleton.joint_names])
    _require_same_parents(own, skeleton, file)
    bones = np.abs(own.offsets[order] - skeleton.offsets)
    # Every clip states the place of its root, and of joints that move relative to their parents.
    bones[[0, *(skeleton.index_of(own.joint_names[joint]) for joint in clip.translated_joints)]] = 0.0
    apart = bones.max(initial=0.0)
    if apart > SAME_OFFSET_M:
        raise FormatError(
            f"the bones of the file differ from those of the chosen skeleton (offsets by up to {apart:.4f} "
            "m); import without choosing a skeleton, then retarget",
            code="skeleton-mismatch",
            file=file,
        )
    rotations = clip.rotations[:, order].reshape(clip.frame_count, -1)
    poses = np.concatenate((clip.poses[:, :3], rotations), axis=1)
    places = {int(old): new for new, old in enumerate(order)}
    moved = [places[joint] for joint in clip.translated_joints]
    ranks = np.argsort(moved)
    translations = None if clip.translations is None else clip.translations[:, ranks]
    clip = Clip(skeleton, clip.frame_rate_hz, poses, translations, tuple(moved[rank] for rank in ranks))
    channels = imported.source.channels
    record = replace(imported.source, channels=tuple(channels[joint] for joint in order) if channels else ())
    return replace(imported, clip=clip, skeleton=skeleton, source=record)
