"""Clips of a project as a matching database, kept from task to task: tasks of one evaluation share it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.normaliser import Normaliser
from marey_motion.matching.options import DatabaseOptions
from marey_motion.matching.search import SearchIndex, build_index
from marey_schemas.canonical import canonical_json, document_digest
from marey_schemas.documents import Motion, RevisionRef
from marey_schemas.evaluation import EvaluateParams
from marey_schemas.jobs import PinnedInput
from marey_schemas.kinds import Kind
from marey_worker.context import Context, JobRefused
from marey_worker.kept import Kept
from marey_worker.kinds.rigged import Rig, read_rigged

LOOP_TAG = "loop"
NAMES_SHOWN = 5
MOST_KEPT = 1
"""Databases; one of an hour of motion takes a few hundred megabytes."""


@dataclass(frozen=True)
class MatchingClips:
    """Clips as motion matching searches them."""

    database: MatchingDatabase

    @cached_property
    def index(self) -> SearchIndex:
        """Of the database's normalised features; made when it is first needed."""
        database = self.database
        return build_index(database.normaliser.apply(database.features), database.starts, database.selectable)


_kept: Kept[bytes, MatchingClips] = Kept(MOST_KEPT)


def read_clips(context: Context, params: EvaluateParams, options: DatabaseOptions) -> MatchingClips:
    """The job's clips, ready to be matched.

    Raises `JobRefused` for clips of several skeletons, for trims that do not fit, for a skeleton that lacks joints, and
    where too little is left to match.
    """
    pins = {name: [(pin.item, pin.revision) for pin in many] for name, many in context.inputs.items()}
    chosen = params.model_dump(mode="json", include={"database", "loops", "trims"})
    key = canonical_json({"inputs": pins, "params": chosen})
    with refusing_motion_errors():
        return _kept.get(key, lambda: MatchingClips(_build(context, params, options)))


@contextmanager
def refusing_motion_errors() -> Iterator[None]:
    """What the mathematics refuses, no second try will change."""
    try:
        yield
    except MotionError as error:
        raise JobRefused(error.code, str(error)) from error


def _build(context: Context, params: EvaluateParams, options: DatabaseOptions) -> MatchingDatabase:
    pins = context.inputs["clips"]
    motions = list(_read_motions(context, pins))
    rig = _common_rig(context, pins, motions)
    rigged = read_rigged(context, rig)
    infos = context.documents(pins, "info", required=False)
    loops = set(params.loops)
    clips = [
        SourceClip(
            uid=f"{pin.item}@{pin.revision}",
            name=_place(pin),
            clip=documents.clip_from_document(motion, rigged.skeleton),
            content=content,
            loop=pin.item in loops or LOOP_TAG in (info or {}).get("tags", ()),
            frames=_trim(pin, motion, params),
            tags=tuple((info or {}).get("tags", ())),
        )
        for (pin, info), (content, motion) in zip(infos, motions, strict=True)
    ]
    context.progress(0, None, f"building a database of {len(clips)} clips")
    body = MatchingBody.from_mapping(rigged.skeleton, rigged.mapping)
    return build_database(clips, body, options, normaliser=_pinned_normaliser(context))


def _read_motions(context: Context, pins: Sequence[PinnedInput]) -> Iterator[tuple[str, Motion]]:
    """Each clip's motion and its digest."""
    for done, (pin, tree) in enumerate(context.documents(pins, "motion")):
        context.progress(0, None, f"reading clip {done + 1} of {len(pins)}, {pin.name}")
        yield document_digest(tree), Motion.model_validate(tree)


def _common_rig(context: Context, pins: Sequence[PinnedInput], motions: Sequence[tuple[str, Motion]]) -> Rig:
    """The skeleton of all clips, at the newest revision in use. Raises `JobRefused` where there are several."""
    used = [RevisionRef.model_validate(motion.skeleton.model_dump()) for _, motion in motions]
    (most, count), *others = Counter(ref.item for ref in used).most_common()
    if others:
        odd = [_place(pin) for pin, ref in zip(pins, used, strict=True) if ref.item != most]
        commonest = context.item(Kind.SKELETON, most)
        place = f"{commonest.collection}/{commonest.name}".lstrip("/")
        raise JobRefused(
            "several-skeletons",
            f"the clips move {len(others) + 1} skeletons: {count} of {len(used)} move {place}, but not {_listed(odd)}; "
            "move all to one of them first, with marey retarget",
        )
    skeleton = max(used, key=lambda ref: ref.revision)
    edited = context.inputs.get("rig", ())
    if edited and edited[0].item != most:
        raise JobRefused("wrong-rig", f"the input rig is {edited[0].item}; the clips move {most}")
    mapping = RevisionRef(item=edited[0].item, revision=edited[0].revision) if edited else skeleton
    return Rig(skeleton, mapping)


def _trim(pin: PinnedInput, motion: Motion, params: EvaluateParams) -> tuple[int, int] | None:
    trim = params.trims.get(pin.item)
    if trim is not None and trim[1] > len(motion.poses):
        frames = len(motion.poses)
        raise JobRefused("bad-trim", f"{_place(pin)}: the frames {trim[0]}:{trim[1]} are not there; it has {frames}")
    return trim


def _pinned_normaliser(context: Context) -> Normaliser | None:
    """The normaliser of the evaluation that the job names, if it names one."""
    for pin in context.inputs.get("normaliser", ()):
        evaluation = context.document(Kind.EVALUATION, pin.item, pin.revision, "evaluation")
        return Normaliser.from_tree(evaluation["normaliser"])
    return None


def _place(pin: PinnedInput) -> str:
    return f"{pin.collection}/{pin.name}".lstrip("/")


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:NAMES_SHOWN])
    return f"{shown} and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else shown
