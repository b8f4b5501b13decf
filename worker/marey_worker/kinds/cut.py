"""Kind `cut`: cuts clips along the segments of their annotations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from marey_motion import documents
from marey_motion.editing.annotations.commands import piece_of
from marey_motion.editing.annotations.layers import Segment
from marey_motion.errors import MotionError
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import ClipInfo, ClipSource, MotionDocument
from marey_schemas.documents.references import OutputRef, RevisionRef
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.queue.job_params import CutParams
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_schemas.wording import counted
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.result_places import ResultPlaces
from marey_worker.job_io.staged_results import StagedResults


def run(context: Context, params: CutParams) -> dict[str, Any]:
    """Create a clip from every selected segment; a clip with keyframes or margins also gets an annotation.

    Raises `JobRefused` if no segment is selected, if two pieces would have the same name, or if no annotation can be
    used.
    """
    return _Cutting(context, params).run()


class _AnnotatedClip(NamedTuple):
    """Annotation with its clip, and the segments to cut out; each segment has the name of the clip that it becomes."""

    pin: PinnedInput
    annotation: Annotation
    clip: RevisionRef
    item: Item | PinnedInput
    pieces: tuple[tuple[Segment, str], ...]


class _Cutting:
    """State of a job of the kind `cut`."""

    def __init__(self, context: Context, params: CutParams) -> None:
        self._context = context
        self._params = params
        self._clip_pins = {(pin.item, pin.revision): pin for pin in context.inputs.get("clips", ())}
        self._clips = {pin.item: pin for pin in context.inputs.get("clips", ())}
        self._places = ResultPlaces(context)
        self._results = StagedResults(context)
        self._refusals = Refusals(context)

    def run(self) -> dict[str, Any]:
        """Cut all clips; return the number of pieces in total and by label, and the refused annotations."""
        labels: Counter[str] = Counter()
        todo = self._read()
        self._require_pieces(todo)
        cut = 0
        for done, one in enumerate(todo):
            self._context.progress(done, len(todo), f"cutting {one.item.name}")
            try:
                for segment, name in one.pieces:
                    for kind in (Kind.CLIP, Kind.ANNOTATION):
                        self._places.take(kind, self._folder(one, segment), name)
                for output, label in self._pieces(one):
                    labels.update([label] if label else [])
                    self._results.add(output)
                cut += bool(one.pieces)
            except UNUSABLE as error:
                self._refusals.add(one.pin, error)
        self._refusals.require_some(cut, len(self._context.inputs["annotations"]), "cut", what="annotation")
        self._results.flush()
        return {"clips": labels.total(), "labels": dict(sorted(labels.items())), "refused": self._refusals.entries}

    # -- what there is to cut --

    def _read(self) -> list[_AnnotatedClip]:
        pins = self._context.inputs["annotations"]
        found = []
        for pin, tree in self._context.documents(pins, "annotation", required=False):
            try:
                annotation = Annotation.model_validate(present(pin, tree))
                if self._params.layer not in (None, annotation.layer):
                    continue
                clip = RevisionRef.model_validate(annotation.clip.model_dump())
                item = self._clip_of(clip)
            except UNUSABLE as error:
                self._refusals.add(pin, error)
                continue
            found.append(_AnnotatedClip(pin, annotation, clip, item, tuple(self._named(annotation, item))))
        return found

    def _clip_of(self, clip: RevisionRef) -> Item | PinnedInput:
        """Return the annotated clip with its name and folder.

        Without an input `clips`, the clip has its present name and folder; `NoSuchThing` is raised if it does not
        exist. With an input `clips`, the clip has the name and folder that it had at the time of submission, because
        results are cached for jobs with the same inputs. Then `MotionError` is raised if the clip is not among the
        inputs.
        """
        if not self._clips:
            return self._context.item(Kind.CLIP, clip.item)
        if clip.item not in self._clips:
            raise MotionError(
                f"the annotation refers to the clip {clip.item}, which is not among the given clips; add this clip, "
                "or give no clips at all",
                code="clip-not-given",
            )
        return self._clip_pins.get((clip.item, clip.revision), self._clips[clip.item])

    def _named(self, annotation: Annotation, clip: Item | PinnedInput) -> Iterator[tuple[Segment, str]]:
        """Yield each selected segment with the name of its piece. The segments of a label are numbered in order."""
        numbers: Counter[str] = Counter()
        for one in annotation.segments:
            numbers[one.label] += 1
            if not self._params.labels or one.label in self._params.labels:
                name = self._params.piece_name(clip.name, one.label, numbers[one.label])
                yield Segment(one.label, one.start, one.end), name

    def _require_pieces(self, todo: Sequence[_AnnotatedClip]) -> None:
        places = Counter((self._folder(one, segment), name) for one in todo for segment, name in one.pieces)
        if not places:
            raise JobRefused("nothing-to-cut", self._why_nothing(todo) + self._refusals.first)
        (folder, name), count = places.most_common(1)[0]
        if count > 1:
            raise JobRefused(
                "same-name",
                f"{count} pieces would have the path {folder}/{name}; cut one layer in each job, or cut each folder "
                "of clips in a job of its own, with another folder for its results",
            )
        long = [name for _, name in places if len(name) > MAX_NAME_LENGTH]
        if long:
            raise JobRefused(
                "name-too-long",
                f"the piece would have the name {long[0]!r} of {len(long[0])} characters, but at most "
                f"{MAX_NAME_LENGTH} are allowed; rename the clip, or give a shorter label or pattern of names",
            )

    def _why_nothing(self, todo: Sequence[_AnnotatedClip]) -> str:
        """Return the reason why no segment is cut out. The text does not mention refused annotations."""
        if not todo:
            layer = self._params.layer
            return "no annotation can be used" if layer is None else f"no annotation of the layer {layer!r} can be used"
        labels = sorted({segment.label for one in todo for segment in one.annotation.segments})
        if not labels:
            return f"the annotations have no segments ({counted(len(todo), 'annotation')} could be used)"
        return f"no segment has one of the chosen labels; the labels of the segments are {', '.join(labels)}"

    def _folder(self, one: _AnnotatedClip, segment: Segment) -> str:
        folder = one.item.folder if isinstance(one.item, PinnedInput) else one.item.collection
        below = (folder, segment.label.replace("/", "-") if self._params.by_label else "")
        return "/".join(filter(None, below))

    # -- pieces --

    def _pieces(self, one: _AnnotatedClip) -> Iterator[tuple[StagedOutput, str | None]]:
        motion = MotionDocument.model_validate(
            self._context.document(Kind.CLIP, one.clip.item, one.clip.revision, "motion")
        )
        info = self._info(one.clip)
        layer = documents.layer_from_document(one.annotation, len(motion.poses))
        for segment, name in one.pieces:
            duration_s = (segment.end - segment.start) / motion.frame_rate_hz
            longest_s = self._params.longest_s
            if duration_s < self._params.shortest_s or (longest_s is not None and duration_s > longest_s):
                continue
            frames = self._with_margins(segment, motion)
            place = f"{self._folder(one, segment)}/{name}"
            common = {
                "item_name": name,
                "collection": self._folder(one, segment),
                "tags": self._params.tags,
                "sources": self._sources(one),
            }
            cut_out = {"motion": _sliced(motion, frames), "info": _piece_info(info, one, segment, frames)}
            yield StagedOutput(name=place, kind=Kind.CLIP, parts=cut_out, **common), segment.label
            said = piece_of(layer, segment, *frames)
            if said.keyframes or frames != (segment.start, segment.end):
                document = documents.layer_to_document(
                    said, OutputRef(output=place), one.annotation.layer, one.annotation.made_by
                )
                parts = {"annotation": document.model_dump(mode="json", by_alias=True)}
                yield StagedOutput(name=f"{place} (annotation)", kind=Kind.ANNOTATION, parts=parts, **common), None

    def _with_margins(self, segment: Segment, motion: MotionDocument) -> tuple[int, int]:
        before, after = (
            round(margin_s * motion.frame_rate_hz)
            for margin_s in (self._params.margin_before_s, self._params.margin_after_s)
        )
        return max(0, segment.start - before), min(len(motion.poses), segment.end + after)

    def _info(self, clip: RevisionRef) -> ClipInfo:
        """Return the part `info` of the clip without its checks, which do not apply to the pieces."""
        stored = self._context.document(Kind.CLIP, clip.item, clip.revision, "info", required=False)
        if stored is None:
            return ClipInfo()
        return ClipInfo.model_validate(stored).model_copy(update={"checks": ()})

    def _sources(self, one: _AnnotatedClip) -> dict[str, tuple[ItemInput, ...]]:
        sources: dict[str, tuple[ItemInput, ...]] = {"annotations": (one.pin.as_input(),)}
        if clip := self._clip_pins.get((one.clip.item, one.clip.revision)):
            sources["clips"] = (clip.as_input(),)
        return sources


def _sliced(motion: MotionDocument, frames: tuple[int, int]) -> dict[str, Any]:
    """Return the part `motion` with only the frames in the half-open range `frames`; values are copied unchanged."""
    kept = slice(*frames)
    translations = None if motion.translations is None else np.ascontiguousarray(motion.translations[kept])
    poses = np.ascontiguousarray(motion.poses[kept])
    return motion.model_copy(update={"poses": poses, "translations": translations}).model_dump(by_alias=True)


def _piece_info(info: ClipInfo, one: _AnnotatedClip, segment: Segment, frames: tuple[int, int]) -> dict[str, Any]:
    details = {
        "clip": one.clip.model_dump(),
        "annotation": one.pin.as_input().model_dump(),
        "label": segment.label,
        "frames": list(frames),
    }
    cut = info.model_copy(update={"source": ClipSource(format="cut", details=details)})
    return cut.model_dump(mode="json", by_alias=True, exclude_none=True)
