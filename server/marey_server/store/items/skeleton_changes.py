"""Checks that new revisions of items, for example from an import, do not change the skeletons of the items."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import and_, select

from marey_server.prepared_documents import PreparedDocument, digest_of_body, with_body
from marey_server.store import documents
from marey_server.store.items.drafts import StoredDocument
from marey_server.store.items.loaded_drafts import LoadedDraft
from marey_server.store.items.references import outputs_in
from marey_server.store.items.same_rigs import RigDocument, is_same_rig, on_rig
from marey_server.store.items.summaries import SKELETON_PARTS, skeleton_of
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, item, revision_part
from marey_server.store.transaction import Transaction, in_lists

Tree = dict[str, Any]


def without_skeleton_changes(tx: Transaction, project: ProjectRow, loaded: list[LoadedDraft]) -> list[LoadedDraft]:
    """Prevent drafts with `same_skeleton` from changing the skeletons of existing items; return the remaining drafts.

    If the skeletons of a draft and of the existing item are the same rig (`is_same_rig`), the draft refers to the
    skeleton of the item instead. It does not if the skeleton of the item is deleted. If the rigs are different, the
    draft is left out, together with the annotations of its clip. The skeleton of the draft is left out, too, if no
    other draft uses it.
    """
    before = _skeletons_before(tx, project, [one for one in loaded if one.draft.same_skeleton])
    if not before:
        return loaded
    by_name = {one.draft.name_in_batch: one for one in loaded}
    after = {name: _reference(by_name[name]) for name in before}
    stored = _stored_rigs(tx, {*before.values(), *(ref["item"] for ref in after.values() if "item" in ref)})

    def is_kept(name: str) -> bool:
        known, reference = stored.get(before[name]), after[name]
        rig = _rig(by_name.get(reference.get("output", "")), stored.get(reference.get("item", "")))
        return known is not None and rig is not None and is_same_rig(known.rig, rig, _moved_by(by_name[name]))

    kept = {name: stored[skeleton_id] for name, skeleton_id in before.items() if is_kept(name)}
    refused = before.keys() - kept.keys()
    refused |= {one.draft.name_in_batch for one in loaded if refused.intersection(one.refers)}
    used = {name for one in loaded if one.draft.name_in_batch not in refused for name in one.refers}
    refused |= {name for one in loaded if one.draft.name_in_batch in refused for name in one.refers} - used
    own = {name: skeleton for name, skeleton in kept.items() if not skeleton.deleted}
    return _on_own_skeletons(tx, [one for one in loaded if one.draft.name_in_batch not in refused], own)


@dataclass(frozen=True)
class _StoredSkeleton:
    """Newest revision of a skeleton of the project."""

    reference: Tree
    rig: RigDocument
    deleted: bool


def _reference(one: LoadedDraft) -> Tree:
    return skeleton_of(one.draft.kind, one.bodies) or {}


def _moved_by(one: LoadedDraft) -> Collection[str]:
    joints: Collection[str] = one.bodies[SKELETON_PARTS[one.draft.kind]].get("translated_joints", ())
    return joints


def _rig(given: LoadedDraft | None, stored: _StoredSkeleton | None) -> RigDocument | None:
    """Return the rig of the skeleton that a draft refers to: another draft (`given`) or a stored skeleton.

    Returns None if it is neither.
    """
    if given is not None and "hierarchy" in given.contents:
        return RigDocument(given.contents["hierarchy"].digest, given.bodies["hierarchy"])
    return None if stored is None else stored.rig


def _on_own_skeletons(
    tx: Transaction, loaded: Sequence[LoadedDraft], own: Mapping[str, _StoredSkeleton]
) -> list[LoadedDraft]:
    """Let the drafts that `own` names refer to the skeletons of their existing items, which `own` contains.

    After this, a new skeleton may have no draft left that uses it. The draft of this skeleton then gets the rig of the
    existing skeleton, so that no skeleton is created from it. Returns all drafts in the same order.
    """
    others = {name for one in loaded if one.draft.name_in_batch not in own for name in one.refers}
    replaced: dict[str, RigDocument] = {}
    changed = []
    for one in loaded:
        skeleton = own.get(one.draft.name_in_batch)
        if skeleton is not None:
            given = _reference(one).get("output")
            if given is not None and given not in others:
                replaced.setdefault(given, skeleton.rig)
            one = _on_skeleton(tx, one, skeleton.reference)
        changed.append(one)
    return [
        on_rig(one, replaced[one.draft.name_in_batch]) if one.draft.name_in_batch in replaced else one
        for one in changed
    ]


def _on_skeleton(tx: Transaction, one: LoadedDraft, reference: Tree) -> LoadedDraft:
    """Return a copy of a draft that refers to another skeleton."""
    part = SKELETON_PARTS[one.draft.kind]
    content, body = one.contents[part], {**one.bodies[part], "skeleton": reference}
    bodies = {**one.bodies, part: body}
    if isinstance(content, StoredDocument):
        documents.store_variants(tx, [(content.digest, body)])
        changed: PreparedDocument | StoredDocument = StoredDocument(digest_of_body(body))
    else:
        changed = with_body(content, body)
    refers = [name for tree in bodies.values() for name in outputs_in(tree)]
    return replace(one, bodies=bodies, contents={**one.contents, part: changed}, refers=refers)


def _skeletons_before(tx: Transaction, project: ProjectRow, drafts: Sequence[LoadedDraft]) -> dict[str, str]:
    """Return the ids of the skeletons that existing items use, by the names of the drafts that revise the items."""
    found = {}
    for some in in_lists(drafts):
        places = {(one.draft.kind.value, one.draft.collection, one.draft.item_name): one for one in some}
        statement = (
            select(item.c.kind, collection.c.path, item.c.name, item.c.skeleton_id)
            .join(collection, collection.c.id == item.c.collection_id)
            .where(
                item.c.project_id == project.id, item.c.deleted_us.is_(None), item.c.skeleton_id.is_not(None),
                item.c.kind.in_({kind for kind, _, _ in places}), item.c.name.in_({name for _, _, name in places}),
            )
        )  # fmt: skip
        for row in tx.execute(statement):
            if (one := places.get((row.kind, row.path, row.name))) is not None:
                found[one.draft.name_in_batch] = row.skeleton_id
    return found


def _stored_rigs(tx: Transaction, ids: set[str]) -> dict[str, _StoredSkeleton]:
    """Return the newest revisions of skeletons, by id."""
    at_head = and_(revision_part.c.item_id == item.c.id, revision_part.c.number == item.c.head)
    statement = select(item.c.id, item.c.head, item.c.deleted_us, revision_part.c.document_digest).join(
        revision_part, at_head
    )
    rows = [
        row
        for some in in_lists(sorted(ids))
        for row in tx.execute(statement.where(item.c.id.in_(some), revision_part.c.part == "hierarchy"))
    ]
    bodies = documents.load_bodies(tx, {row.document_digest for row in rows})
    rigs = {digest: RigDocument(digest, body) for digest, body in bodies.items()}
    return {
        row.id: _StoredSkeleton(
            {"item": row.id, "revision": row.head}, rigs[row.document_digest], row.deleted_us is not None
        )
        for row in rows
    }
