"""Skeletons of one rig: takes of a rig whose files differ only in numbers that mean nothing use one skeleton."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import and_, select

from marey_schemas.kinds import Kind
from marey_server.store import documents
from marey_server.store.items.drafts import StoredDocument
from marey_server.store.items.loaded_drafts import LoadedDraft
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import item, revision_part
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]

MOST_COMPARED = 500
"""Greatest number of skeletons of a project with which a new skeleton is compared: the newest ones."""
SAME_NUMBER = 1e-5
"""Greatest difference of equal bones, in metres, and of equal rotations: writers round numbers."""

_UNTURNED = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RigDocument:
    """Document `hierarchy` of a skeleton. `moved` are the joints whose offsets the motions of all its clips replace."""

    digest: str
    body: Tree
    moved: frozenset[str] = frozenset()


def on_known_rigs(tx: Transaction, project: ProjectRow, loaded: list[LoadedDraft]) -> list[LoadedDraft]:
    """Replace the hierarchies of skeletons to be reused by content with those of the same rigs in the project."""
    moved: dict[str, set[str]] = {}
    for one in loaded:
        joints = set(one.bodies.get("motion", {}).get("translated_joints", ()))
        for name in one.refers:
            moved[name] = moved.get(name, joints) & joints
    new = {
        one.draft.name_in_batch: RigDocument(
            one.contents["hierarchy"].digest, one.bodies["hierarchy"], frozenset(moved.get(name, ()))
        )
        for one in loaded
        for name in (one.draft.name_in_batch,)
        if one.draft.kind is Kind.SKELETON and one.draft.reuse == "by_content" and "hierarchy" in one.contents
    }
    known = _known_rigs(tx, project, new) if new else {}
    brought = {rig.digest: one.contents["hierarchy"] for one in loaded if (rig := new.get(one.draft.name_in_batch))}

    def on_rig(one: LoadedDraft, rig: RigDocument) -> LoadedDraft:
        kept = brought.get(rig.digest) or StoredDocument(rig.digest)
        return replace(one, contents={**one.contents, "hierarchy": kept}, bodies={**one.bodies, "hierarchy": rig.body})

    return [on_rig(one, known[one.draft.name_in_batch]) if one.draft.name_in_batch in known else one for one in loaded]


def _known_rigs(tx: Transaction, project: ProjectRow, new: Mapping[str, RigDocument]) -> dict[str, RigDocument]:
    """Return for some of the new skeletons, by name, the skeleton of the project or of an earlier one that is its rig.

    A skeleton whose digest the project has is left alone. The root's offset does not count, because every clip states
    the place of its root.
    """
    if {rig.digest for rig in new.values()} <= _stored_digests(tx, project).keys():
        return {}
    tx.lock(f"content:{project.id}:{Kind.SKELETON}")  # as publication does, so that two imports see each other
    stored = _stored_digests(tx, project)
    unknown = {name: rig for name, rig in new.items() if rig.digest not in stored}
    compared = list(stored)[-MOST_COMPARED:]
    bodies = documents.load_bodies(tx, compared)
    candidates = [RigDocument(digest, bodies[digest]) for digest in compared]
    found = {}
    for name, rig in unknown.items():
        same = next((one for one in candidates if one.digest == rig.digest or is_same_rig(one, rig)), None)
        if same is None:
            candidates.append(rig)
        elif same.digest != rig.digest:
            found[name] = same
    return found


def _stored_digests(tx: Transaction, project: ProjectRow) -> dict[str, str]:
    """Return the digests of the hierarchies of a project, with the ids of their items, the oldest first."""
    statement = (
        select(revision_part.c.document_digest, item.c.id)
        .join(item, and_(item.c.id == revision_part.c.item_id, item.c.head == revision_part.c.number))
        .where(
            item.c.project_id == project.id, item.c.kind == Kind.SKELETON.value, item.c.deleted_us.is_(None),
            revision_part.c.part == "hierarchy",
        )
        .order_by(item.c.id)
    )  # fmt: skip
    return {row.document_digest: row.id for row in tx.execute(statement)}


def is_same_rig(known: RigDocument, new: RigDocument) -> bool:
    """Return whether the clips of a new skeleton mean the same on a known one.

    Clips that move a joint of the known skeleton do not count: those of the new skeleton need the offset of this joint.
    """
    return _structure(known.body) == _structure(new.body) and all(
        abs(a - b) <= SAME_NUMBER
        for a, b in zip(_numbers(known.body, new.moved), _numbers(new.body, new.moved), strict=True)
    )


def rig_difference(known: RigDocument, new: RigDocument) -> str:
    """Return, as part of a sentence, what makes two skeletons different rigs."""
    first, second = ([joint["name"] for joint in rig.body["joints"]] for rig in (known, new))
    if odd := sorted(set(first) ^ set(second)):
        return f"only one of them has {', '.join(odd[:5])}{', ...' if len(odd) > 5 else ''}"
    if _structure(known.body) != _structure(new.body):
        return "their joints have other parents, or another order"
    farthest = max(
        abs(a - b) for a, b in zip(_numbers(known.body, new.moved), _numbers(new.body, new.moved), strict=True)
    )
    return f"their offsets or rest rotations differ by up to {farthest:.2g}"


def _structure(body: Tree) -> tuple[object, ...]:
    joints = tuple((joint["name"], joint["parent"], joint.get("display_name")) for joint in body["joints"])
    return joints, tuple(site["joint"] for site in body.get("end_sites", ()))


def _numbers(body: Tree, moved: Collection[str]) -> Iterator[float]:
    """Yield the numbers of a hierarchy that the motion of a clip does not replace."""
    for joint in body["joints"]:
        if joint["parent"] >= 0 and joint["name"] not in moved:
            yield from joint["offset"]
        yield from joint.get("rest_rotation", _UNTURNED)
    for site in body.get("end_sites", ()):
        yield from site["offset"]
