"""Import of one file: bytes in, documents of skeletons, clips and models out. No files, network or database."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, mapping_to_document, skeleton_to_document
from marey_motion.errors import FormatError, MappingError
from marey_motion.formats import read_source
from marey_motion.formats.conversion import convert
from marey_motion.formats.predecessor.graph import PredecessorGraph
from marey_motion.importing.plan import PlannedFile
from marey_motion.importing.source import ImportedMotion, ImportOptions, SourceDocument
from marey_motion.importing.units import unit_in_metres
from marey_motion.rigs import JointAxes, JointMapping, guess_axes, map_joints
from marey_motion.skeleton import Skeleton

SKELETON_OUTPUT = "skeleton"
"""What a clip calls the skeleton of its own file until both are stored."""
SAME_OFFSET_M = 1e-3

Tree = dict[str, Any]


@dataclass(frozen=True)
class ImportRequest:
    """What the user says about a whole batch, beside `ImportOptions`: words for the record, and the skeleton to use.

    `skeleton_ref` is `{"item", "revision"}` of `skeleton`.
    """

    options: ImportOptions = field(default_factory=ImportOptions)
    subject: str | None = None
    licence: str | None = None
    capture_system: str | None = None
    skeleton: Skeleton | None = None
    skeleton_ref: Mapping[str, Any] | None = None


_READER_OPTIONS = tuple(option.name for option in fields(ImportOptions))


@dataclass(frozen=True)
class FileDigests:
    """Digests of a file's bytes and of its companion's, for the record of a clip's origin."""

    file: str
    companion: str | None = None
    companion_name: str | None = None


@dataclass(frozen=True)
class ModelledDocuments:
    """What a file of the predecessor says that is no motion: a model, with a tree over its samples; or a graph.

    Parameters
    ----------
    name : what it is called
    parts : of a model: `model`, whose skeleton may be called `SKELETON_OUTPUT`, and perhaps `tree`
    """

    name: str
    parts: Mapping[str, Tree] = field(default_factory=dict)
    graph: PredecessorGraph | None = None


@dataclass(frozen=True)
class ImportedDocuments:
    """The documents of one file: a skeleton, and a clip or a model unless it holds none.

    Clips and models may use a skeleton that was given.
    """

    skeleton_name: str
    hierarchy: Tree | None
    mapping: Tree | None
    motion: Tree | None
    info: Tree | None
    checks: tuple[Tree, ...]
    modelled: ModelledDocuments | None = None


def import_options(given: Mapping[str, Any]) -> ImportOptions:
    """Select the options of the readers from those of an import.

    Parameters
    ----------
    given : mapping of str to object    options of an import, the unit by name or by its size in metres

    Returns
    -------
    ImportOptions    options of the readers
    """
    chosen = {name: given[name] for name in _READER_OPTIONS if given.get(name) is not None}
    if given.get("unit") is not None:
        chosen.setdefault("unit_scale_m", unit_in_metres(given["unit"]))
    return ImportOptions(**chosen)


def import_file(
    planned: PlannedFile,
    data: bytes | memoryview,
    digests: FileDigests,
    request: ImportRequest,
    companion: bytes | memoryview | None = None,
) -> ImportedDocuments:
    """Read one file and make its documents.

    Parameters
    ----------
    planned : PlannedFile    plan of the file
    data : bytes    its content
    digests : FileDigests    digests of the file and its companion
    request : ImportRequest    facts given by the user
    companion : bytes, optional    content of the companion

    Returns
    -------
    ImportedDocuments    documents of the skeleton and the clip or model

    Raises
    ------
    MotionError    with code, file, line and joint where they are known
    """
    source = read_source(
        data,
        planned.name,
        companion=companion,
        companion_name=planned.companion or "the companion",
        options=request.options,
    )
    if isinstance(source, SourceDocument):
        from marey_motion.importing.models import import_modelled

        return import_modelled(planned, source, request, digests, None if companion is None else bytes(companion))
    imported = convert(source, planned.name, request.options)
    checks = tuple(_check_document(warning.as_dict()) for warning in imported.warnings)
    info = _info(imported, planned, digests, request, checks) if imported.clip is not None else None
    if request.skeleton is not None and imported.clip is not None:
        clip = _on_skeleton(imported.clip, request.skeleton, planned.name)
        motion = clip_to_document(clip, dict(request.skeleton_ref or {}))  # type: ignore[arg-type]
        return ImportedDocuments("", None, None, as_tree(motion), info, checks)
    mapping, axes = _anatomy(imported)
    motion_tree = None
    if imported.clip is not None:
        motion_tree = as_tree(clip_to_document(imported.clip, {"output": SKELETON_OUTPUT}))  # type: ignore[arg-type]
    return ImportedDocuments(
        mapping.rig or "skeleton",
        as_tree(skeleton_to_document(imported.skeleton)),
        as_tree(mapping_to_document(mapping, axes)),
        motion_tree,
        info,
        checks,
    )


def _anatomy(imported: ImportedMotion) -> tuple[JointMapping, dict[str, JointAxes]]:
    return anatomy_of(imported.skeleton, imported.clip)


def anatomy_of(skeleton: Skeleton, clip: Clip | None) -> tuple[JointMapping, dict[str, JointAxes]]:
    """Determine the joint mapping and axes of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    clip : Clip or None    motion to read the axes from

    Returns
    -------
    mapping : JointMapping    standard joints; with a note where the axes cannot be determined
    axes : dict of str to JointAxes    by joint name; empty where they cannot be determined
    """
    mapping = map_joints(skeleton)
    try:
        return mapping, guess_axes(skeleton, mapping, clip)
    except MappingError as error:
        return replace(mapping, notes=(*mapping.notes, f"no axes: {error.message}")), {}


def as_tree(document: Any) -> Tree:
    """Convert a document to plain values and arrays.

    Parameters
    ----------
    document : model    a document of `marey_schemas`

    Returns
    -------
    dict    plain values and arrays
    """
    tree: Tree = document.model_dump(by_alias=True, exclude_none=True)
    return tree


def _check_document(warning: Tree) -> Tree:
    return {key: value for key, value in warning.items() if value is not None}


def _info(
    imported: ImportedMotion,
    planned: PlannedFile,
    digests: FileDigests,
    request: ImportRequest,
    checks: tuple[Tree, ...],
) -> Tree:
    details = {key: value for key, value in imported.source.as_dict().items() if key not in ("format", "file")}
    source = {
        "file": digests.file,
        "file_name": planned.name,
        "companion": digests.companion,
        "companion_name": digests.companion_name,
        "format": imported.source.format,
        "details": details,
    }
    info = {
        "schema": "marey/clip-info@1",
        "subject": request.subject,
        "capture_system": request.capture_system,
        "licence": request.licence,
        "source": {key: value for key, value in source.items() if value is not None},
        "checks": list(checks),
    }
    return {key: value for key, value in info.items() if value is not None}


def _on_skeleton(clip: Clip, skeleton: Skeleton, file: str) -> Clip:
    """The clip on a given skeleton, which must be the file's own but for its name and its order of joints."""
    own = clip.skeleton
    if set(own.joint_names) != set(skeleton.joint_names):
        odd = ", ".join(sorted(set(own.joint_names) ^ set(skeleton.joint_names))[:5])
        raise FormatError(
            f"its joints are not those of the skeleton asked for ({odd}); leave the skeleton out and retarget instead",
            code="skeleton-mismatch",
            file=file,
        )
    order = np.array([own.index_of(name) for name in skeleton.joint_names])
    parents = [own.joint_names[parent] if parent >= 0 else None for parent in own.parents[order]]
    wanted = [skeleton.joint_names[parent] if parent >= 0 else None for parent in skeleton.parents]
    apart = np.abs(own.offsets[order] - skeleton.offsets)[1:].max(initial=0.0)
    if parents != wanted or apart > SAME_OFFSET_M:
        raise FormatError(
            f"its bones are not those of the skeleton asked for (offsets differ by up to {apart:.4f} m); "
            "leave the skeleton out and retarget instead",
            code="skeleton-mismatch",
            file=file,
        )
    rotations = clip.rotations[:, order].reshape(clip.frame_count, -1)
    poses = np.concatenate((clip.poses[:, :3], rotations), axis=1)
    places = {int(old): new for new, old in enumerate(order)}
    moved = [places[joint] for joint in clip.translated_joints]
    ranks = np.argsort(moved)
    translations = None if clip.translations is None else clip.translations[:, ranks]
    return Clip(skeleton, clip.frame_rate_hz, poses, translations, tuple(moved[rank] for rank in ranks))
