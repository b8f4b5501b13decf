"""Documents of the motions of a study, at the revisions that the study pins, for its participants."""

from __future__ import annotations

from typing import Literal

from sqlalchemy import select

from marey_schemas.documents.studies import StudyMotion
from marey_schemas.kinds import Kind
from marey_server.errors import GoneProblem, NotFoundProblem
from marey_server.store import documents
from marey_server.store.items.consents import find_ended_consents
from marey_server.store.items.reading import FoundPart
from marey_server.store.studies.designs import load_design
from marey_server.store.studies.participants import find_caller
from marey_server.store.tables import document, item, revision_part
from marey_server.store.transaction import Transaction

ShownPart = Literal["motion", "hierarchy", "mapping"]
"""Document that a participant may read: the motion of a clip, its skeleton, or the joint mapping of the skeleton."""


def find_shown_part(tx: Transaction, clip: int, part: ShownPart) -> FoundPart:
    """Return a document of one motion of the caller's study.

    Raises `NotFoundProblem` if the study has no such motion, or if the skeleton has no mapping. Raises `GoneProblem` if
    the clip was deleted, or if the consent of its performer has ended.
    """
    row = find_caller(tx)
    motions = load_design(tx, row.item_id, row.revision).motions
    if clip >= len(motions):
        raise NotFoundProblem(
            f"The study has no motion {clip}; it has {len(motions)} motions, numbered from 0.", code="no-clip"
        )
    place = _place_of(motions[clip])
    if find_ended_consents(tx, [place[0]]):
        raise _gone()
    motion = _find(tx, row.project_id, Kind.CLIP, place, "motion")
    if motion is None:
        raise _gone()
    if part == "motion":
        return motion
    ref = documents.load_body(tx, motion.digest)["skeleton"]
    found = _find(tx, row.project_id, Kind.SKELETON, (ref["item"], ref["revision"]), part)
    if found is None:
        raise NotFoundProblem(f"The skeleton of this motion has no {part}.", code="no-part")
    return found


def _place_of(motion: StudyMotion) -> tuple[str, int]:
    return motion.revision.item, motion.revision.revision


def _gone() -> GoneProblem:
    return GoneProblem("This motion may not be shown any more.", code="clip-gone")


def _find(tx: Transaction, project_id: str, kind: Kind, place: tuple[str, int], part: str) -> FoundPart | None:
    statement = (
        select(revision_part.c.document_digest, document.c.size_bytes, item.c.rev)
        .join(item, item.c.id == revision_part.c.item_id)
        .join(document, document.c.digest == revision_part.c.document_digest)
        .where(
            item.c.id == place[0],
            item.c.project_id == project_id,
            item.c.kind == kind.value,
            item.c.deleted_us.is_(None),
            revision_part.c.number == place[1],
            revision_part.c.part == part,
        )
    )
    found = tx.execute(statement).first()
    return None if found is None else FoundPart(found.document_digest, place[1], found.rev, found.size_bytes)
