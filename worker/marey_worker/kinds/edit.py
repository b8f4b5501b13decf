"""Kind `edit`: applies the commands of an edit to clips."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from marey_motion import documents
from marey_motion.clip import Clip
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.editing.take import EditedBody
from marey_motion.errors import EditError, MotionError
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.clips import Check, ClipInfo, ClipSource, MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.editing.edits import EditDocument
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import EditParams
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_schemas.validation.reasons import first_reason
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.result_places import ResultPlaces
from marey_worker.job_io.skeleton_cache import Rig, read_mapped
from marey_worker.job_io.staged_results import StagedResults


def run(context: Context, params: EditParams) -> dict[str, Any]:
    """Apply the commands to every clip of the job.

    A clip that cannot be edited is listed as a refusal in the result, with code and reason. Raises `JobRefused` if no
    clip can be edited, or if a clip to which a command refers cannot be used. Also raises `JobRefused` if the commands
    are missing or given twice, or if it is not clear where the results go.
    """
    return _Editing(context, params).run()


class _Editing:
    """State of a job of the kind `edit`."""

    def __init__(self, context: Context, params: EditParams) -> None:
        self._context = context
        self._params = params
        self._results = StagedResults(context)
        self._rigs = {pin.item: pin for pin in context.inputs.get("rigs", ())}
        self._bodies: dict[RevisionRef, EditedBody] = {}
        self._frames = 0
        self._refusals = Refusals(context)
        self._places = ResultPlaces(context)
        self._findings: list[dict[str, Any]] = []
        self._source_infos: list[ClipInfo] = []
        if (unclear := params.unclear_place(context.into)) is not None:
            raise JobRefused("ambiguous-place", unclear)
        self._edit_pin, self._edit = _wanted_edit(context, params)
        self._source_pins = _wanted_sources(context, self._edit)

    def run(self) -> dict[str, Any]:
        """Edit all clips, and return the result of the job."""
        pins = self._context.inputs["clips"]
        started = time.monotonic()
        sources = self._read_sources()
        for done, (pin, (motion, info)) in enumerate(self._context.documents_of_each(pins, "motion", "info")):
            self._context.progress(done, len(pins), f"editing {pin.name}")
            try:
                outputs = list(self._edited(pin, MotionDocument.model_validate(present(pin, motion)), info, sources))
            except UNUSABLE as error:
                self._refusals.add(pin, error)
                continue
            for output in outputs:
                self._results.add(output)
        self._refusals.require_some(self._results.count, len(pins), "edited")
        self._results.flush()
        return {
            "clips": self._results.count,
            "frames": self._frames,
            "seconds": round(time.monotonic() - started, 4),
            "findings": self._findings,
            "refused": self._refusals.entries,
        }

    def _read_sources(self) -> dict[str, Clip]:
        pins = tuple(self._source_pins.values())
        sources = {}
        for pin, (tree, info) in self._context.documents_of_each(pins, "motion", "info"):
            motion = MotionDocument.model_validate(present(pin, tree))
            self._source_infos += [] if info is None else [ClipInfo.model_validate(info)]
            try:
                sources[pin.item] = documents.clip_from_document(motion, self._body(motion).skeleton)
            except MotionError as error:
                raise JobRefused(error.code, f"the source clip {pin.path} cannot be used: {error}") from error
        return sources

    def _edited(
        self, pin: PinnedInput, motion: MotionDocument, known: dict[str, Any] | None, sources: Mapping[str, Clip]
    ) -> Iterator[StagedOutput]:
        """Edit one clip, and yield the results. Raises `MotionError` or `NoSuchThing` if the clip cannot be edited."""
        if self._params.in_place:
            self._require_newest(pin)
        body = self._body(motion)
        clip = documents.clip_from_document(motion, body.skeleton)
        made = edit_clip(clip, self._edit.commands, body=body, sources=sources)
        if self._params.in_place and len(made) > 1:
            raise EditError(
                "the edit splits the clip, and several clips cannot replace one clip; set in_place to false",
                code="several-clips",
            )
        info = self._info(pin, known)
        names = [f"{pin.name}{self._params.suffix}" + "".join(f"-{n}" for n in one.pieces) for one in made]
        if self._params.in_place:
            self._places.keep(pin)
        else:
            self._places.take(Kind.CLIP, pin.folder, *names)
        for name, one in zip(names, made, strict=True):
            self._note(pin, name, one)
            checks = tuple(
                Check(code="edit-warning", message=f"{found.command}: {found.values['warning']}")
                for found in one.findings
                if "warning" in found.values
            )
            yield self._output(pin, name, one.clip, motion, info.model_copy(update={"checks": checks}))

    def _output(self, pin: PinnedInput, name: str, clip: Clip, motion: MotionDocument, info: ClipInfo) -> StagedOutput:
        rig = self._rigs.get(_skeleton_of(motion).item)
        pins: dict[str, list[PinnedInput | None]] = {
            "clips": [pin],
            "edit": [self._edit_pin],
            "sources": [*self._source_pins.values()],
            "rigs": [rig],
        }
        sources = {role: tuple(one.as_input() for one in many if one is not None) for role, many in pins.items()}
        return StagedOutput(
            name=f"{pin.collection}/{name}",
            kind=Kind.CLIP,
            item_name=name,
            collection=pin.collection if self._params.in_place else pin.folder,
            tags=self._params.tags,
            parts={
                "motion": documents.clip_to_document(clip, motion.skeleton).model_dump(by_alias=True),
                "info": info.model_dump(mode="json", by_alias=True, exclude_none=True),
            },
            sources={role: many for role, many in sources.items() if many},
        )

    def _body(self, motion: MotionDocument) -> EditedBody:
        """Return the skeleton of a motion, with a function that reads its joint mapping when a command needs it.

        Raises `MotionError` if the skeleton is not valid.
        """
        used = _skeleton_of(motion)
        if used not in self._bodies:
            tree = self._context.document(Kind.SKELETON, used.item, used.revision, "hierarchy")
            skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(tree))
            edited = self._rigs.get(used.item)
            mapping = used if edited is None else RevisionRef(item=edited.item, revision=edited.revision)
            rig = Rig(used, mapping)

            def find_mapping(_skeleton: Skeleton) -> Any:
                return read_mapped(self._context, rig).mapping

            self._bodies[used] = EditedBody(skeleton, find_mapping)
        return self._bodies[used]

    def _info(self, pin: PinnedInput, stored: dict[str, Any] | None) -> ClipInfo:
        """Return the part `info` of a result: that of the clip, with the applied edit and without checks.

        The consent is at least as strict as the consents of the clip and of all clips to which the commands refer.
        """
        edit = None if self._edit_pin is None else self._edit_pin.as_input().model_dump()
        done = {
            "clip": pin.as_input().model_dump(),
            "edit": edit,
            "commands": [command.command for command in self._edit.commands],
        }
        known = (ClipInfo() if stored is None else ClipInfo.model_validate(stored)).with_consent_of(self._source_infos)
        source = ClipSource(format="edited", details=done)
        if self._params.in_place and known.source is not None:
            # It is still the clip of that file; only its motion is another.
            source = known.source.model_copy(update={"details": {**known.source.details, "edited": done}})
        return known.model_copy(update={"source": source, "checks": ()})

    # -- where results go --

    def _require_newest(self, pin: PinnedInput) -> None:
        """Raise `EditError` if the clip to be replaced was changed, moved or renamed since the job was submitted."""
        now = self._context.item(Kind.CLIP, pin.item)
        if now.revision != pin.revision:
            raise EditError(
                f"the job edits revision {pin.revision}, but the clip now has revision {now.revision}; "
                "submit the edit again",
                code="clip-changed",
            )
        if (now.collection, now.name) != (pin.collection, pin.name):
            raise EditError(
                "the clip was moved or renamed while the job waited; submit the edit again", code="clip-changed"
            )

    # -- messages --

    def _note(self, pin: PinnedInput, name: str, made: EditedClip) -> None:
        self._frames += made.clip.frame_count
        place = f"{pin.collection}/{name}".lstrip("/")
        self._findings += [
            {"name": place, "item": pin.item, "command": one.command, **one.values} for one in made.findings
        ]


def _wanted_edit(context: Context, params: EditParams) -> tuple[PinnedInput | None, EditDocument]:
    """Return the item of the kind `edit` that contains the commands, and the commands.

    The item is None if the parameters of the job contain the commands. Raises `JobRefused` if both an item and
    parameters give commands, or neither of them, or if the item is not valid.
    """
    (pin,) = context.inputs.get("edit", ()) or (None,)
    if (pin is None) == (not params.commands):
        raise JobRefused(
            "which-commands", "the job needs either an input `edit` or the parameter `commands`, and not both"
        )
    if pin is None:
        return None, EditDocument(commands=params.commands)
    try:
        return pin, EditDocument.model_validate(context.document(Kind.EDIT, pin.item, pin.revision, "edit"))
    except ValidationError as error:
        raise JobRefused("bad-document", f"the edit {pin.path} cannot be applied: {first_reason(error)}") from error


def _wanted_sources(context: Context, edit: EditDocument) -> dict[str, PinnedInput]:
    """Return the clips to which commands refer, from the input `sources`, by id.

    Raises `JobRefused` if such a clip is missing, or given at two revisions.
    """
    given = [pin for pin in context.inputs.get("sources", ()) if pin.item in edit.sources]
    found = {pin.item: pin for pin in given}
    if len(found) < len(given):
        raise JobRefused("which-source", "the input `sources` contains two revisions of one clip; give each clip once")
    missing = [item for item in edit.sources if item not in found]
    if missing:
        raise JobRefused(
            "source-missing", f"the commands refer to {', '.join(missing)}; add these clips to the input `sources`"
        )
    return found


def _skeleton_of(motion: MotionDocument) -> RevisionRef:
    return RevisionRef.model_validate(motion.skeleton.model_dump())
