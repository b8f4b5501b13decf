"""Matching databases of the clips of a job.

They are cached between jobs, because all tasks of an evaluation use the same database.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from pydantic import ValidationError

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.copies import index_of
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.search import SearchIndex
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.canonical import canonical_json, document_digest
from marey_schemas.items import LOOP_TAG
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.options.matching import DatabaseOptions
from marey_schemas.queue.job_params import EvaluateParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_schemas.validation.reasons import first_reason
from marey_schemas.wording import counted, listed
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.skeleton_cache import Rig, read_mapped

MOST_KEPT = 1
"""Greatest number of cached databases; the database of an hour of motion takes a few hundred megabytes."""


@dataclass(frozen=True)
class MatchingClips:
    """Matching database of clips, and its search index."""

    database: MatchingDatabase

    @cached_property
    def index(self) -> SearchIndex:
        """The search index of the database's normalised features, built at the first use."""
        return index_of(self.database)


_cache: LruCache[bytes, MatchingClips] = LruCache(max_entries=MOST_KEPT)


@dataclass(frozen=True)
class ClipSet:
    """Clips of a matching database, with their trims and loops.

    These clips, the options and the normaliser determine the database. `trims` maps items to half-open ranges of
    frames; `loops` lists the items that are loops; `rig` is the skeleton revision whose joint mapping is used.
    """

    clips: tuple[PinnedInput, ...]
    rig: PinnedInput | None = None
    loops: tuple[str, ...] = ()
    trims: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def as_tree(self) -> dict[str, Any]:
        """Return the set as plain values, which are stored with an evaluation."""
        return {
            "clips": [pin.model_dump(mode="json") for pin in self.clips],
            "rig": None if self.rig is None else self.rig.model_dump(mode="json"),
            "loops": list(self.loops),
            "trims": {item: list(frames) for item, frames in self.trims.items()},
        }

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> ClipSet:
        """Return the set of clips that a result of `as_tree` describes."""
        return cls(
            clips=tuple(map(PinnedInput.model_validate, tree["clips"])),
            rig=None if tree["rig"] is None else PinnedInput.model_validate(tree["rig"]),
            loops=tuple(tree["loops"]),
            trims={item: (start, stop) for item, (start, stop) in tree["trims"].items()},
        )


def wanted_clips(context: Context, params: EvaluateParams) -> ClipSet:
    """Return the clips that the job evaluates, with their trims and loops, from its inputs and parameters."""
    (rig,) = context.inputs.get("rig", ()) or (None,)
    return ClipSet(context.inputs["clips"], rig, params.loops, params.trims)


def read_clips(context: Context, params: EvaluateParams, options: DatabaseOptions) -> MatchingClips:
    """Return the matching database of the job's clips, from the cache if possible.

    Raises `JobRefused` if the clips have several skeletons, a skeleton lacks joints, a trim is outside its clip, or
    there are too few frames.
    """
    pins = {name: [(pin.item, pin.revision) for pin in many] for name, many in context.inputs.items()}
    chosen = params.model_dump(mode="json", include={"database", "loops", "trims"})
    wanted = wanted_clips(context, params)
    with refusing_motion_errors():
        return _cache.get_or_make(
            canonical_json({"inputs": pins, "params": chosen}),
            lambda: MatchingClips(build_set(context, wanted, options, _pinned_normaliser(context))),
        )


def evaluated_clip_set(evaluation: PinnedInput, document: Mapping[str, Any]) -> ClipSet:
    """Return the clips that an evaluation lists in its `document`. Raises `JobRefused` if it lists none."""
    if "clip_set" not in document:
        raise JobRefused(
            "clips-unknown",
            f"the evaluation {evaluation.path} does not list its clips, because an old version of "
            "Marey created it; evaluate the clips again",
        )
    return ClipSet.from_tree(document["clip_set"])


def read_evaluated_clips(
    context: Context, evaluation: PinnedInput, wanted: ClipSet, document: Mapping[str, Any], options: DatabaseOptions
) -> MatchingClips:
    """Return the matching database of an evaluation's clips `wanted`, at the revisions that were evaluated.

    The database has the normaliser of the evaluation. Raises `JobRefused` if the clips cannot be used.
    """
    normaliser = Normaliser.from_tree(document["normaliser"])
    with refusing_motion_errors():
        return _cache.get_or_make(
            canonical_json({"evaluation": [evaluation.item, evaluation.revision]}),
            lambda: MatchingClips(build_set(context, wanted, options, normaliser)),
        )


@contextmanager
def refusing_motion_errors() -> Iterator[None]:
    """Convert a `MotionError`, or an error of invalid options, to a `JobRefused`, so that the job is not retried."""
    try:
        yield
    except MotionError as error:
        raise JobRefused(error.code, str(error)) from error
    except ValidationError as error:
        raise JobRefused("option-invalid", first_reason(error)) from error


def build_set(
    context: Context, wanted: ClipSet, options: DatabaseOptions, normaliser: Normaliser | None
) -> MatchingDatabase:
    """Read the clips of a set, and return their matching database.

    Without a `normaliser`, one is computed from the clips. Raises `JobRefused` if the clips have several skeletons, if
    `wanted.rig` is another skeleton, or if a trim is outside its clip. Raises `MotionError` if the clips cannot be used
    for motion matching.
    """
    motions = list(read_motions(context, wanted.clips))
    mapped = read_mapped(context, common_rig(context, wanted, [skeleton_of(motion) for _, motion in motions]))
    body = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)
    return build_clips(context, wanted, motions, body, options, normaliser)


def build_clips(
    context: Context,
    wanted: ClipSet,
    motions: Sequence[tuple[str, MotionDocument]],
    body: MatchingBody,
    options: DatabaseOptions,
    normaliser: Normaliser | None,
) -> MatchingDatabase:
    """Return the matching database of clips that were read.

    `motions` contains, for each clip of `wanted`, the digest of its part `motion`, and the motion. `body` is the
    skeleton with the joints for matching.
    """
    infos = context.documents(wanted.clips, "info", required=False)
    clips = [
        SourceClip(
            uid=uid_of(pin),
            name=pin.path,
            clip=documents.clip_from_document(motion, body.skeleton),
            content=content,
            loop=is_loop(pin, info, wanted.loops),
            frames=_trim(pin, motion, wanted.trims),
            tags=tuple((info or {}).get("tags", ())),
        )
        for (pin, info), (content, motion) in zip(infos, motions, strict=True)
    ]
    context.progress(0, None, f"building a database of {counted(len(clips), 'clip')}")
    return build_database(clips, body, options, normaliser=normaliser)


def is_loop(pin: PinnedInput, info: Mapping[str, Any] | None, loops: Sequence[str]) -> bool:
    """Return whether a clip is a loop: the job lists its item in `loops`, or its part `info` has the loop tag."""
    return pin.item in loops or LOOP_TAG in (info or {}).get("tags", ())


def uid_of(pin: PinnedInput) -> str:
    """Return the unique name of a clip in a database, made of item and revision, as in `clip_01h2@3`."""
    return f"{pin.item}@{pin.revision}"


def split_uid(uid: str) -> tuple[str, int]:
    """Return the item and the revision that `uid_of` has joined."""
    item, _, revision = uid.rpartition("@")
    return item, int(revision)


def read_motions(context: Context, pins: Sequence[PinnedInput]) -> Iterator[tuple[str, MotionDocument]]:
    """Yield the digest of the part `motion` of each clip, and the motion."""
    for done, (pin, tree) in enumerate(context.documents(pins, "motion")):
        context.progress(0, None, f"reading clip {done + 1} of {len(pins)}, {pin.name}")
        yield document_digest(tree), MotionDocument.model_validate(tree)


def skeleton_of(motion: MotionDocument) -> RevisionRef:
    """Return the reference to the skeleton's revision that a motion uses."""
    return RevisionRef.model_validate(motion.skeleton.model_dump())


def common_rig(context: Context, wanted: ClipSet, used: Sequence[RevisionRef]) -> Rig:
    """Return the skeleton that all clips have, at the newest of the revisions in `used`.

    `used` contains the skeleton's revision for each clip of `wanted`. The joint mapping is that of `wanted.rig`, if it
    is given. Raises `JobRefused` if there are several skeletons, or if `wanted.rig` is another skeleton.
    """
    (most, count), *others = Counter(ref.item for ref in used).most_common()
    if others:
        odd = [pin.path for pin, ref in zip(wanted.clips, used, strict=True) if ref.item != most]
        commonest = context.item(Kind.SKELETON, most)
        place = commonest.path
        raise JobRefused(
            "several-skeletons",
            f"the clips have {len(others) + 1} different skeletons: {count} of {len(used)} have {place}, but "
            f"{listed(odd)} do not; move all clips to one skeleton first, with `marey retarget`",
        )
    skeleton = max(used, key=lambda ref: ref.revision)
    edited = wanted.rig
    if edited is not None and edited.item != most:
        raise JobRefused(
            "wrong-rig",
            f"the input `rig` is the skeleton {edited.item}, but the clips have the skeleton {most}; give "
            f"a revision of {most} as `rig`",
        )
    mapping = skeleton if edited is None else RevisionRef(item=edited.item, revision=edited.revision)
    return Rig(skeleton, mapping)


def _trim(pin: PinnedInput, motion: MotionDocument, trims: Mapping[str, tuple[int, int]]) -> tuple[int, int] | None:
    trim = trims.get(pin.item)
    if trim is not None and trim[1] > len(motion.poses):
        frames = len(motion.poses)
        raise JobRefused(
            "bad-trim",
            f"{pin.path}: the range of frames {trim[0]}:{trim[1]} is outside the clip, which has {frames} frames",
        )
    return trim


def _pinned_normaliser(context: Context) -> Normaliser | None:
    """Return the normaliser of the evaluation in the input `normaliser`, or None if the job has no such input."""
    for pin in context.inputs.get("normaliser", ()):
        evaluation = context.document(Kind.EVALUATION, pin.item, pin.revision, "evaluation")
        return Normaliser.from_tree(evaluation["normaliser"])
    return None
