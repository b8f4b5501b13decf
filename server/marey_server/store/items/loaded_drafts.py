"""Drafts with the documents of their parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from marey_schemas.kinds import PARTS
from marey_server.errors import InvalidProblem
from marey_server.prepared_documents import PreparedDocument, prepared
from marey_server.store import documents
from marey_server.store.items import references
from marey_server.store.items.drafts import Draft, StoredDocument
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]


@dataclass(frozen=True)
class LoadedDraft:
    """Draft with the documents of its parts, in the order that its kind declares.

    `refers` lists the drafts that these documents refer to.
    """

    draft: Draft
    bodies: Mapping[str, Tree]
    contents: Mapping[str, PreparedDocument | StoredDocument]
    refers: Sequence[str]


def load_drafts(tx: Transaction, drafts: Sequence[Draft]) -> list[LoadedDraft]:
    """Load the documents of drafts. Raises `InvalidProblem` for a part that the kind of the draft does not have."""
    contents = [_contents(draft) for draft in drafts]
    stored = {one.digest for parts in contents for one in parts.values() if isinstance(one, StoredDocument)}
    loaded = documents.load_bodies(tx, stored)
    answer = []
    for draft, parts in zip(drafts, contents, strict=True):
        bodies = {
            part: loaded[one.digest] if isinstance(one, StoredDocument) else one.body for part, one in parts.items()
        }
        refers = [name for tree in bodies.values() for name in references.outputs_in(tree)]
        answer.append(LoadedDraft(draft, bodies, parts, refers))
    return answer


def _contents(draft: Draft) -> dict[str, PreparedDocument | StoredDocument]:
    specs = PARTS[draft.kind]
    if unknown := [part for part in draft.parts if part not in specs]:
        raise InvalidProblem(
            f"An item of the kind {draft.kind} has no part {unknown[0]!r}; its parts are {', '.join(specs)}.",
            code="no-part",
        )
    given = {part: draft.parts[part] for part in specs if part in draft.parts}
    return {
        part: content if isinstance(content, StoredDocument) else prepared(content, schema=specs[part].schema)
        for part, content in given.items()
    }
