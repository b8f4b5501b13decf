"""Kind `align`: aligns examples of one action with each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from marey_motion import documents
from marey_motion.alignment import aligned_documents
from marey_motion.alignment.aligned import AlignedClip, AlignedSet, Recording
from marey_motion.alignment.aligning import MIRRORED, SourceExample, align_clips, with_mirrored
from marey_motion.alignment.segments import Cut, cuts_of
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.perception.metric import metric_of
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import ClipInfo, MotionDocument
from marey_schemas.documents.metrics import MetricIdentity
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.options.alignment import MEDOID, NEAREST_MEAN_LENGTH, AlignOptions
from marey_schemas.queue.job_params import AlignParams
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.chosen_metric import read_metric
from marey_worker.job_io.matching_clips import refusing_motion_errors
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.result_places import require_different
from marey_worker.job_io.skeleton_cache import Rig, read_mapped
from marey_worker.job_io.staged_results import StagedResults

MIRRORED_NAME = " mirrored"


class _Clip(NamedTuple):
    """Clip that may become an example: its input, motion, digest of the motion, and skeleton."""

    pin: PinnedInput
    motion: MotionDocument
    content: str
    skeleton: RevisionRef


class _ClipAnnotation(NamedTuple):
    """Annotation of a revision of a clip."""

    pin: PinnedInput
    annotation: Annotation
    clip: RevisionRef


def run(context: Context, params: AlignParams) -> dict[str, Any]:
    """Align the clips of the job.

    A clip that cannot be aligned is listed as a refusal in the result, with code and reason. Raises `JobRefused` if
    fewer than two clips can be aligned, or if two results would have the same name.
    """
    return _Job(context, params).run()


class _Job:
    """State of a job of the kind `align`."""

    def __init__(self, context: Context, params: AlignParams) -> None:
        self._context = context
        self._params = params
        self._pins = {_uid(pin): pin for pin in context.inputs["clips"]}
        self._refusals = Refusals(context)
        self._annotations: dict[str, PinnedInput] = {}
        self._metric = read_metric(context, params.metric)

    def run(self) -> dict[str, Any]:
        self._require_names()
        clips = self._of_one_skeleton(list(self._read()))
        rig = self._rig(clips)
        with refusing_motion_errors():
            mapped = read_mapped(self._context, rig)
            body = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)
            examples = list(self._examples(clips, body))
            self._require_examples(examples, clips)
            aligned = align_clips(
                with_mirrored(examples, body) if self._params.mirroring == "add" else examples,
                body,
                self._options(),
                metric=None if self._metric is None else metric_of(self._metric),
                threads=self._context.threads,
                progress=self._context.progress,
                on_refusal=lambda example, error: self._refusals.add(
                    self._pin_of(example.uid), error, name=example.name
                ),
            )
        digest = self._digest(clips, examples, rig)
        self._stage(aligned, rig.skeleton, digest)
        return self._result(aligned, digest)

    # -- what is aligned --

    def _require_names(self) -> None:
        """Raise `JobRefused` if two results would have the same name, or if a name is too long.

        Called before any computation.
        """
        endings = ("", MIRRORED_NAME) if self._params.mirroring == "add" else ("",)
        names = [(pin.folder, self._name(pin, ending)) for pin in self._pins.values() for ending in endings]
        require_different(names)
        long = [name for _, name in names if len(name) > MAX_NAME_LENGTH]
        if long:
            raise JobRefused(
                "name-too-long",
                f"the result would have the name {long[0]!r} of {len(long[0])} characters, but at most "
                f"{MAX_NAME_LENGTH} are allowed; rename the clip, or give a shorter suffix",
            )

    def _name(self, pin: PinnedInput, ending: str) -> str:
        return f"{pin.name}{self._params.suffix}{ending}"

    def _read(self) -> Iterator[_Clip]:
        pins = self._context.inputs["clips"]
        for done, (pin, tree) in enumerate(self._context.documents(pins, "motion", required=False)):
            self._context.progress(done, len(pins), f"reading {pin.name}")
            try:
                motion = MotionDocument.model_validate(present(pin, tree))
            except UNUSABLE as error:
                self._refusals.add(pin, error)
                continue
            yield _Clip(pin, motion, document_digest(tree), RevisionRef.model_validate(motion.skeleton.model_dump()))

    def _of_one_skeleton(self, clips: Sequence[_Clip]) -> list[_Clip]:
        """Return the clips that have the most frequent skeleton; the other clips are added to the refusals."""
        counts = Counter(clip.skeleton.item for clip in clips)
        most = min(counts, key=lambda item: (-counts[item], item), default=None)
        others = [clip for clip in clips if clip.skeleton.item != most]
        if others:
            theirs = self._context.item(Kind.SKELETON, str(most)).path
            error = MotionError(
                f"it has another skeleton than {counts[str(most)]} of {len(clips)} clips, which have {theirs}; move "
                "all clips to one skeleton first, with `marey retarget` or `marey build-model --to`",
                code="skeleton-mismatch",
            )
            for clip in others:
                self._refusals.add(clip.pin, error)
        return [clip for clip in clips if clip.skeleton.item == most]

    def _rig(self, clips: Sequence[_Clip]) -> Rig:
        """Return the skeleton of the clips at the newest revision that they use, with its joint mapping.

        The joint mapping is that of the input `rig`, if it is given. Raises `JobRefused` if there are no clips, or if
        `rig` is another skeleton.
        """
        if not clips:
            raise JobRefused("too-few-clips", f"none of {len(self._pins)} clips can be read{self._refusals.first}")
        skeleton = max((clip.skeleton for clip in clips), key=lambda ref: ref.revision)
        for edited in self._context.inputs.get("rig", ()):
            if edited.item != skeleton.item:
                raise JobRefused(
                    "wrong-rig",
                    f"the input `rig` is the skeleton {edited.item}, but the clips have the skeleton "
                    f"{skeleton.item}; give a revision of {skeleton.item} as `rig`",
                )
            return Rig(skeleton, RevisionRef(item=edited.item, revision=edited.revision))
        return Rig.as_stored(skeleton)

    def _examples(self, clips: Sequence[_Clip], body: MatchingBody) -> Iterator[SourceExample]:
        annotations = self._read_annotations()
        recordings = self._recordings(clips)
        for one in clips:
            try:
                clip = documents.clip_from_document(one.motion, body.skeleton)
                cuts = self._cuts(one, annotations) if annotations is not None else ()
            except MotionError as error:
                self._refusals.add(one.pin, error)
                continue
            yield SourceExample(_uid(one.pin), one.pin.path, clip, cuts, recordings[_uid(one.pin)])

    def _recordings(self, clips: Sequence[_Clip]) -> dict[str, Recording]:
        """Return take and performer of each clip, from its part `info`. A clip without `info` is a take of its own."""
        infos = self._context.documents([one.pin for one in clips], "info", required=False)
        return {
            _uid(pin): Recording(pin.item) if tree is None else _recording(pin, ClipInfo.model_validate(tree))
            for pin, tree in infos
        }

    def _require_examples(self, examples: Sequence[SourceExample], clips: Sequence[_Clip]) -> None:
        count = len(examples) * (2 if self._params.mirroring == "add" else 1)
        if count < 2:
            raise JobRefused(
                "too-few-clips",
                f"only {len(examples)} of {len(clips)} clips can be aligned, but alignment needs at least "
                f"two{self._refusals.first}",
            )

    # -- annotations --

    def _read_annotations(self) -> dict[str, list[_ClipAnnotation]] | None:
        """Return the given annotations of the requested layer, by id of the clip; None if no annotations are given.

        Raises `JobRefused` if a layer or labels are given without annotations.
        """
        pins = self._context.inputs.get("annotations", ())
        if not pins:
            if self._params.layer is not None or self._params.labels:
                raise JobRefused(
                    "no-annotations",
                    "the parameters layer and labels select annotations, but no annotations are given; add the "
                    "annotations of the clips, or leave out these parameters",
                )
            return None
        found: dict[str, list[_ClipAnnotation]] = {}
        for pin, tree in self._context.documents(pins, "annotation"):
            annotation = Annotation.model_validate(tree)
            clip = RevisionRef.model_validate(annotation.clip.model_dump())
            if self._params.layer in (None, annotation.layer):
                found.setdefault(clip.item, []).append(_ClipAnnotation(pin, annotation, clip))
        return found

    def _cuts(self, clip: _Clip, annotations: Mapping[str, Sequence[_ClipAnnotation]]) -> tuple[Cut, ...]:
        """Return the frames at which a clip's annotation cuts the clip.

        An annotation of the clip's own revision has precedence over annotations of other revisions of the clip. Raises
        `MotionError` if no annotation, or more than one, can be used.
        """
        known = annotations.get(clip.pin.item, ())
        known = [one for one in known if one.clip.revision == clip.pin.revision] or known
        if len(known) != 1:
            layers = ", ".join(sorted({one.annotation.layer for one in known}))
            raise MotionError(
                f"the clip has {len(known)} annotations that could be used (layers: {layers}); name one layer"
                if known
                else f"none of the given annotations{self._of_layer()} belongs to this clip; add an annotation of "
                "the clip, or omit the clip",
                code="several-annotations" if known else "no-annotation",
            )
        (one,) = known
        self._annotations[_uid(clip.pin)] = one.pin
        layer = documents.layer_from_document(self._wanted(one.annotation), len(clip.motion.poses))
        return cuts_of(layer)

    def _wanted(self, annotation: Annotation) -> Annotation:
        if not self._params.labels:
            return annotation
        wanted = set(self._params.labels)
        return annotation.model_copy(
            update={
                "segments": tuple(one for one in annotation.segments if one.label in wanted),
                "keyframes": tuple(one for one in annotation.keyframes if one.label in wanted),
            }
        )

    def _of_layer(self) -> str:
        return f" of the layer {self._params.layer!r}" if self._params.layer else ""

    # -- options --

    def _options(self) -> AlignOptions:
        """Return the options of the alignment.

        If the reference is given by the id of a clip, it becomes the name (id and revision) of this clip at its newest
        revision among the inputs. Raises `JobRefused` if the clip is not among the inputs.
        """
        options = AlignOptions.of(self._params)
        if options.reference in (MEDOID, NEAREST_MEAN_LENGTH):
            return options
        named = [pin for pin in self._pins.values() if pin.item == options.reference]
        if not named:
            raise JobRefused(
                "unknown-reference",
                f"the reference {options.reference} is not one of the clips; give the id of one of them",
            )
        return options.replace(reference=_uid(max(named, key=lambda pin: pin.revision)))

    def _digest(self, clips: Sequence[_Clip], examples: Sequence[SourceExample], rig: Rig) -> str:
        """Return the digest of all inputs and options of the alignment.

        Clips that were aligned together have the same digest.
        """
        contents = {aligned_documents.uid_of(one.pin.item, one.pin.revision): one.content for one in clips}
        return document_digest(
            {
                "examples": [
                    {
                        "uid": one.uid,
                        "motion": contents[one.uid],
                        "cuts": [[list(cut.labels), cut.frame] for cut in one.cuts],
                    }
                    for one in examples
                ],
                "rig": [rig.skeleton.model_dump(), rig.mapping.model_dump()],
                "options": self._written_options(),
                **self._metric_tree(),
            }
        )

    def _written_options(self) -> dict[str, Any]:
        """Return the parameters as a document; without a metric, the member `metric` is left out."""
        return self._params.model_dump(mode="json", exclude={"metric"} if self._params.metric is None else set())

    def _metric_tree(self) -> dict[str, Any]:
        """Return the member `metric` of documents, which identifies the metric; empty without a metric."""
        return {} if self._metric is None else {"metric": MetricIdentity.of(self._metric).model_dump(mode="json")}

    # -- results --

    def _pin_of(self, uid: str) -> PinnedInput:
        return self._pins[uid.removesuffix(MIRRORED)]

    def _stage(self, aligned: AlignedSet, skeleton: RevisionRef, digest: str) -> None:
        options = self._written_options()
        results = StagedResults(self._context)
        for done, one in enumerate(aligned.clips):
            self._context.progress(done, len(aligned.clips), "writing results")
            results.add(self._output(aligned, one, skeleton, digest, options))
        results.flush()

    def _output(
        self, aligned: AlignedSet, one: AlignedClip, skeleton: RevisionRef, digest: str, options: dict[str, Any]
    ) -> StagedOutput:
        pin = self._pin_of(one.uid)
        reference = self._pin_of(aligned.reference)
        ending = MIRRORED_NAME if one.uid.endswith(MIRRORED) else ""
        motion = documents.clip_to_document(one.motion.as_clip(aligned.skeleton, aligned.frame_rate_hz), skeleton)
        sources = {"clips": tuple(used.as_input() for used in dict.fromkeys((pin, reference)))}
        if _uid(pin) in self._annotations:
            sources["annotations"] = (self._annotations[_uid(pin)].as_input(),)
        for name in ("rig", "metric"):
            if pins := self._context.inputs.get(name):
                sources[name] = tuple(used.as_input() for used in pins)
        return StagedOutput(
            name=f"{pin.collection}/{self._name(pin, ending)}",
            kind=Kind.PROCESSED,
            item_name=self._name(pin, ending),
            collection=pin.folder,
            tags=self._params.tags,
            parts={
                "motion": motion.model_dump(by_alias=True),
                "info": {
                    **aligned_documents.example_to_tree(aligned, one, digest=digest, options=options),
                    **self._metric_tree(),
                },
            },
            sources=sources,
        )

    def _result(self, aligned: AlignedSet, digest: str) -> dict[str, Any]:
        reference = next(one for one in aligned.clips if one.uid == aligned.reference)
        return {
            "clips": len(aligned.clips),
            "frames": aligned.frame_count,
            "frame_rate_hz": aligned.frame_rate_hz,
            "reference": reference.name,
            "keyframes": dict(aligned.keyframes),
            "mean_cost": float(np.mean([one.cost for one in aligned.clips])),
            "set": digest,
            **self._metric_tree(),
            "aligned": [_row(one) for one in aligned.clips],
            "refused": self._refusals.entries,
        }


def _recording(pin: PinnedInput, info: ClipInfo) -> Recording:
    """Return take and performer of a clip.

    For a piece that was cut from another clip, that clip is the take. For other clips, performer, day, action and take
    in `info` are joined; without a take in `info`, the clip counts as a take of its own.
    """
    cut_from = info.source.details.get("clip") if info.source is not None and info.source.format == "cut" else None
    item = cut_from.get("item") if isinstance(cut_from, dict) else None
    facts = (info.subject, info.shoot_day, info.action, info.take)
    recorded = " · ".join(str(fact) for fact in facts if fact is not None) if info.take else pin.item
    return Recording(str(item or recorded)[:MAX_NAME_LENGTH], info.subject or "")


def _row(one: AlignedClip) -> dict[str, Any]:
    """Return the entry of an aligned clip in the job's result."""
    slopes = np.diff(one.time_function)
    return {
        "name": one.name,
        "item": one.uid.rpartition("@")[0],
        "frames": one.source_frames,
        "cost": one.cost,
        "least_slope": float(slopes.min()),
        "greatest_slope": float(slopes.max()),
    }


def _uid(pin: PinnedInput) -> str:
    return aligned_documents.uid_of(pin.item, pin.revision)
