"""Previews of edits, which show the result of commands without storing it.

One transaction reads the inputs; a child process computes the result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.editing.edits import EditDocument
from marey_schemas.editing.previews import EditPreview, EditPreviewRequest
from marey_schemas.kinds import Kind
from marey_schemas.problems import FieldError
from marey_schemas.wording import counted
from marey_server.errors import InvalidProblem, NotFoundProblem, TooLargeProblem
from marey_server.field_errors import field_errors
from marey_server.motions.child import AnswerEncoding, Message, pack_tree, unpack_tree
from marey_server.store import items
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules are loaded by children alone: they take a second, and 100 MB of memory
    from marey_motion.clip import Clip
    from marey_motion.editing.registry import EditedClip
    from marey_motion.editing.take import EditedBody

Tree = dict[str, Any]

MAKE_PREVIEW = "marey_server.motions.previewing:make_preview"
"""Function that child processes run."""
MOST_WORK = 5e9
"""Greatest cost of a preview, in nanoseconds of one thread (estimated). Jobs have no such limit."""
MOST_NUMBERS = 50_000_000
"""Greatest number of values in all motions of the request together, and in any intermediate motion."""
MOST_SHOWN = 5_000_000
"""Greatest number of values in the answer."""


@dataclass(frozen=True, slots=True)
class PreviewSource:
    """Inputs of a preview: the commands, the motions, and the motions' skeletons and joint mappings.

    `hierarchies` maps a skeleton's item and revision to its hierarchy; `mappings` maps the item to its newest joint
    mapping.
    """

    edit: EditDocument
    motion: Tree
    sources: dict[str, Tree] = field(default_factory=dict)
    hierarchies: dict[tuple[str, int], Tree] = field(default_factory=dict)
    mappings: dict[str, Tree] = field(default_factory=dict)


class PreviewOrder(Message):
    """Message that asks a child process to compute a preview: the request, its inputs as bytes, and limits."""

    request: EditPreviewRequest
    edit: EditDocument
    motion: bytes
    sources: dict[str, bytes]
    hierarchies: tuple[tuple[str, int, bytes], ...]
    mappings: dict[str, bytes]
    encoding: AnswerEncoding
    most_work: float
    most_shown: int

    def source(self) -> PreviewSource:
        """Return the edit and its inputs with decoded documents."""
        return PreviewSource(
            self.edit,
            unpack_tree(self.motion),
            {name: unpack_tree(motion) for name, motion in self.sources.items()},
            {(item, revision): unpack_tree(hierarchy) for item, revision, hierarchy in self.hierarchies},
            {name: unpack_tree(mapping) for name, mapping in self.mappings.items()},
        )


def read_preview(tx: Transaction, project: str, kind: Kind, item_id: str, request: EditPreviewRequest) -> PreviewSource:
    """Return the inputs of a preview.

    Raises `NotFoundProblem` if an input does not exist, and `InvalidProblem` if the stored edit is not valid. Raises
    `TooLargeProblem` if the motions are so large that only a job may edit them.
    """
    if kind is not Kind.CLIP:
        raise NotFoundProblem(
            f"Only clips can be edited, not an item of the kind {kind}; name a clip.", code="not-a-clip"
        )
    edit = EditDocument(commands=request.commands) if request.edit is None else _read_edit(tx, project, request)
    motion = items.read_part(tx, project, Kind.CLIP, item_id, "motion", revision=request.revision).tree
    numbers = _size(motion)
    source = PreviewSource(edit, motion)
    for name in edit.sources:
        source.sources[name] = items.read_part(tx, project, Kind.CLIP, name, "motion").tree
        numbers += _size(source.sources[name])
    if numbers > MOST_NUMBERS:
        raise TooLargeProblem(
            "The motions are too long for a preview; submit a job of the kind `edit` instead.", code="preview-too-large"
        )
    for one in (motion, *source.sources.values()):
        skeleton, revision = one["skeleton"]["item"], one["skeleton"]["revision"]
        hierarchy = items.read_part(tx, project, Kind.SKELETON, skeleton, "hierarchy", revision=revision)
        source.hierarchies[skeleton, revision] = hierarchy.tree
        if "mapping" in items.read_item(tx, project, Kind.SKELETON, skeleton).parts:
            source.mappings[skeleton] = items.read_part(tx, project, Kind.SKELETON, skeleton, "mapping").tree
    return source


def _read_edit(tx: Transaction, project: str, request: EditPreviewRequest) -> EditDocument:
    assert request.edit is not None
    named = request.edit
    tree = items.read_part(tx, project, Kind.EDIT, named.item, "edit", revision=named.revision).tree
    try:
        return EditDocument.model_validate(tree)
    except ValidationError as error:
        first = field_errors(error, EditDocument, tree)[0]
        detail = f"The edit cannot be applied: {first.pointer}: {first.detail}; correct the edit, or send `commands`."
        raise _invalid("/edit", "bad-document", detail) from error


def _size(motion: Tree) -> int:
    frames, width = motion["poses"].shape
    return int(frames * width)


def preview_order(source: PreviewSource, request: EditPreviewRequest, encoding: AnswerEncoding) -> bytes:
    """Return the packed message that asks a child process to compute a preview."""
    return PreviewOrder(
        request=request,
        edit=source.edit,
        motion=pack_tree(source.motion),
        sources={name: pack_tree(motion) for name, motion in source.sources.items()},
        hierarchies=tuple((*place, pack_tree(hierarchy)) for place, hierarchy in source.hierarchies.items()),
        mappings={name: pack_tree(mapping) for name, mapping in source.mappings.items()},
        encoding=encoding,
        most_work=MOST_WORK,
        most_shown=MOST_SHOWN,
    ).pack()


# -- in the child ------------------------------------------------------------------------------------------------------


def make_preview(packed: bytes) -> bytes:
    """Compute a preview, in a child process. `packed` is a `PreviewOrder` as bytes.

    Return the document of the preview, encoded for the client. Raises `InvalidProblem` if the commands cannot be
    applied, or if the result does not have the requested frames. Raises `TooLargeProblem` if the edit or the requested
    range is too large.
    """
    from marey_motion.documents import clip_to_document
    from marey_motion.kinematics import global_positions

    order = PreviewOrder.unpack(packed)
    source, request = order.source(), order.request
    made = _edited(source, order.most_work)
    if request.piece >= len(made):
        detail = f"The edit creates only {counted(len(made), 'clip')}; set `piece` to at most {len(made) - 1}."
        raise _invalid("/piece", "no-piece", detail)
    wanted = made[request.piece]
    start, stop = request.frames
    stop = min(wanted.clip.frame_count, wanted.clip.frame_count if stop is None else stop)
    if start >= stop:
        frames = counted(wanted.clip.frame_count, "frame")
        detail = f"The new clip has {frames}, and the range contains none of them; begin the range below this number."
        raise _invalid("/frames", "no-frames", detail)
    shown = wanted.clip.sliced(start, stop)
    if shown.poses.size > order.most_shown:
        most = order.most_shown // shown.poses.shape[1]
        detail = f"{stop - start} frames are too many for one preview of this clip; request at most {most}."
        raise TooLargeProblem(detail, code="preview-too-large")
    skeleton = MotionDocument.model_validate(source.motion).skeleton
    preview = EditPreview(
        pieces=len(made),
        frame_count=wanted.clip.frame_count,
        frame_rate_hz=shown.frame_rate_hz,
        frames=(start, stop),
        motion=clip_to_document(shown, skeleton) if "motion" in request.fields else None,
        positions=np.asarray(global_positions(shown)) if "positions" in request.fields else None,
        findings=tuple({"command": one.command, **one.values} for one in wanted.findings)
        if "findings" in request.fields
        else (),
    )
    return order.encoding.encode(preview.model_dump(by_alias=True, exclude_none=True))


def _edited(source: PreviewSource, most_work: float) -> tuple[EditedClip, ...]:
    """Return the clips that the edit creates.

    Raises `TooLargeProblem` if the edit is so large that only a job may compute it, and `InvalidProblem` if a command
    cannot be applied.
    """
    from marey_motion.editing.registry import edit_clip
    from marey_motion.errors import MotionError

    try:
        clip, body = _clip_of(source, source.motion)
        sources = {name: _clip_of(source, tree)[0] for name, tree in source.sources.items()}
        return edit_clip(
            clip, source.edit.commands, body=body, sources=sources, most_numbers=MOST_NUMBERS, most_work=most_work
        )
    except MotionError as error:
        if error.code in ("edit-too-large", "edit-too-long"):
            raise TooLargeProblem(f"{error}; submit a job instead.", code="preview-too-large") from error
        raise _invalid("/commands", error.code, str(error)) from error


def _clip_of(source: PreviewSource, tree: Tree) -> tuple[Clip, EditedBody]:
    """Return a clip and its skeleton; the joint mapping is parsed when a command needs it.

    Raises `MotionError` if the motion or the skeleton is not valid.
    """
    from marey_motion.documents import clip_from_document, skeleton_from_document, trusted_mapping
    from marey_motion.editing.take import EditedBody
    from marey_motion.rigs import JointMapping
    from marey_motion.skeleton import Skeleton

    ref = tree["skeleton"]
    hierarchy = SkeletonHierarchy.model_validate(source.hierarchies[ref["item"], ref["revision"]])
    stored = source.mappings.get(ref["item"])

    def find_mapping(skeleton: Skeleton) -> JointMapping:
        document = None if stored is None else SkeletonMapping.model_validate(stored)
        return trusted_mapping(document, skeleton)[0]

    skeleton = skeleton_from_document(hierarchy)
    return clip_from_document(MotionDocument.model_validate(tree), skeleton), EditedBody(skeleton, find_mapping)


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, code=code, errors=[FieldError(pointer=pointer, code=code, detail=detail)])
