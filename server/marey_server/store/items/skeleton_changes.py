"""Skeletons of items that get new revisions: an import must not change the skeleton of a clip unasked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import and_, select

from marey_server.store.items.loaded_drafts import LoadedDraft
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, item, revision_part
from marey_server.store.transaction import Transaction, in_lists

Tree = dict[str, Any]


def skeleton_of(bodies: Mapping[str, Tree]) -> Tree | None:
    """Return the reference to the skeleton of an item, given the documents of its parts; None if it has none."""
    moved = bodies.get("motion") or bodies.get("model")
    reference: Tree | None = None if moved is None else moved.get("skeleton")
    return reference


def without_skeleton_changes(tx: Transaction, project: ProjectRow, loaded: list[LoadedDraft]) -> list[LoadedDraft]:
    """Leave out drafts with `same_skeleton` that would change the skeleton of an item, and what belongs to them alone.

    To a clip belong its annotations, and a skeleton that no other draft uses. Skeletons are equal if their hierarchies
    are.
    """
    before = _skeletons_before(tx, project, [one for one in loaded if one.draft.same_skeleton])
    if not before:
        return loaded
    by_name = {one.draft.name_in_batch: one for one in loaded}
    after = {name: skeleton_of(by_name[name].bodies) or {} for name in before}
    stored = _hierarchies(tx, {*before.values(), *(ref["item"] for ref in after.values() if "item" in ref)})

    def hierarchy(reference: Tree) -> str | None:
        given = by_name.get(reference.get("output", ""))
        return stored.get(reference.get("item", "")) if given is None else given.contents["hierarchy"].digest

    refused = {name for name, skeleton_id in before.items() if hierarchy(after[name]) != stored.get(skeleton_id)}
    refused |= {one.draft.name_in_batch for one in loaded if refused.intersection(one.refers)}
    used = {name for one in loaded if one.draft.name_in_batch not in refused for name in one.refers}
    refused |= {name for one in loaded if one.draft.name_in_batch in refused for name in one.refers} - used
    return [one for one in loaded if one.draft.name_in_batch not in refused]


def _skeletons_before(tx: Transaction, project: ProjectRow, drafts: Sequence[LoadedDraft]) -> dict[str, str]:
    """Return the ids of the skeletons of the items that drafts would revise, by the names of the drafts."""
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


def _hierarchies(tx: Transaction, ids: set[str]) -> dict[str, str]:
    """Return the digests of the newest hierarchies of skeletons, by id."""
    at_head = and_(revision_part.c.item_id == item.c.id, revision_part.c.number == item.c.head)
    statement = select(item.c.id, revision_part.c.document_digest).join(revision_part, at_head)
    return {
        row.id: row.document_digest
        for some in in_lists(sorted(ids))
        for row in tx.execute(statement.where(item.c.id.in_(some), revision_part.c.part == "hierarchy"))
    }
