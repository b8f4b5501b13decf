"""Candidates: clips that may be added to an evaluated set, in one matching database for each folder and skeleton."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.selection import source_of
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.database import MatchingDatabase
from marey_motion.skeleton import SAME_OFFSET_M, same_hierarchy
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_schemas.wording import counted
from marey_worker.context import Context
from marey_worker.job_io.evaluated_set import EvaluatedSet
from marey_worker.job_io.matching_clips import ClipSet, build_clips, read_motions, uid_of
from marey_worker.job_io.skeleton_cache import Rig, read_mapped


class Unusable(NamedTuple):
    """Folder of candidates whose clips cannot be used for motion matching, with the number of clips and the reason."""

    folder: str
    clips: int
    code: str
    detail: str


@dataclass
class Candidates:
    """Candidates of a job, in one matching database for each group.

    A group contains the clips of one folder that have the same skeleton. `databases` maps the names of groups to
    databases, which have the options and the normaliser of the evaluated set. `unusable` lists the groups whose clips
    cannot be used.
    """

    databases: dict[str, MatchingDatabase] = field(default_factory=dict)
    unusable: list[Unusable] = field(default_factory=list)


class _Group(NamedTuple):
    pins: list[PinnedInput]
    motions: list[tuple[str, MotionDocument]]


def read_candidates(context: Context, evaluated: EvaluatedSet) -> Candidates:
    """Return the matching databases of the job's input `candidates`, without clips of the evaluated set."""
    database = evaluated.clips.database
    known = {source_of(clip) for clip in database.clips}
    pins = [pin for pin in context.inputs.get("candidates", ()) if uid_of(pin) not in known]
    groups: dict[tuple[str, str], _Group] = defaultdict(lambda: _Group([], []))
    for pin, motion in zip(pins, read_motions(context, pins), strict=True):
        group = groups[pin.collection, _skeleton_of(motion).item]
        group.pins.append(pin)
        group.motions.append(motion)
    found = Candidates()
    for name, group in _named(context, groups):
        try:
            found.databases[name] = _build(context, group, database)
        except MotionError as error:
            found.unusable.append(Unusable(name, len(group.pins), error.code, str(error)))
            context.log(f"{name}: {counted(len(group.pins), 'clip')} cannot be matched: {error}")
    return found


def _named(context: Context, groups: dict[tuple[str, str], _Group]) -> Iterator[tuple[str, _Group]]:
    """Yield each group with its name.

    The name is the folder, with the name of the skeleton if the folder has clips of several skeletons.
    """
    for (folder, skeleton), group in groups.items():
        alone = sum(other == folder for other, _ in groups) == 1
        yield folder if alone else f"{folder} ({context.item(Kind.SKELETON, skeleton).name})", group


def _build(context: Context, group: _Group, database: MatchingDatabase) -> MatchingDatabase:
    """Return the matching database of a group, with the options and the normaliser of `database`.

    If the skeleton of the group equals that of `database`, the joints for matching are taken from `database`;
    otherwise, from the joint mapping of the group's skeleton.
    """
    newest = max(map(_skeleton_of, group.motions), key=lambda ref: ref.revision)
    mapped = read_mapped(context, Rig.as_stored(newest))
    body = database.body
    if not same_hierarchy(mapped.skeleton, body.skeleton, tolerance_m=SAME_OFFSET_M):
        body = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)
    return build_clips(context, ClipSet(tuple(group.pins)), group.motions, body, database.options, database.normaliser)


def _skeleton_of(motion: tuple[str, MotionDocument]) -> RevisionRef:
    return RevisionRef.model_validate(motion[1].skeleton.model_dump())
