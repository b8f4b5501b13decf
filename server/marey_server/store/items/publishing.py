"""Publication of drafts: the only code that creates revisions."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import and_, insert, select

from marey_schemas.kinds import PARTS, Kind
from marey_server import faults
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import collections, documents
from marey_server.store.documents import PreparedDocument
from marey_server.store.ids import new_id
from marey_server.store.items import references
from marey_server.store.items.drafts import Draft, Published, StoredDocument
from marey_server.store.items.revisions import read_part_digests, write_head, write_revision
from marey_server.store.items.summaries import summarise
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import item, item_tag, lineage, revision_part
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]

_RACES = 20
"""Number of attempts to publish while concurrent writes are faster."""


def publish(
    tx: Transaction,
    project_row: ProjectRow,
    drafts: Sequence[Draft],
    *,
    author_id: str | None,
    job_id: str | None = None,
) -> list[Published]:
    """Create items and revisions from drafts, all or none; return them in the order of the drafts.

    `{"output": name}` in a document refers to another draft and is replaced by its item and revision; the
    `model_digest` of a tree may name the model of its own draft. Content that is stored already creates no new
    revision. The caller has authorised the write.

    Raises `InvalidProblem` for a draft that is not valid, `ConflictProblem` for a name that is taken.
    """
    by_name = {draft.name_in_batch: draft for draft in drafts}
    if len(by_name) != len(drafts):
        raise InvalidProblem("Two results of the request have the same name.", code="duplicate-output")
    loaded = {name: _load_parts(tx, draft) for name, draft in by_name.items()}
    refers = {
        name: [found for part in parts.values() for found in references.outputs_in(part.body)]
        for name, parts in loaded.items()
    }
    publication = _Publication(tx, project_row, author_id, job_id)
    for name in references.in_order(refers):
        publication.add(by_name[name], loaded[name], resolve=bool(refers[name]))
    faults.point("publish.before_commit")
    tx.after_commit(lambda: faults.point("publish.after_commit"))
    return [publication.done[draft.name_in_batch] for draft in drafts]


@dataclass(frozen=True)
class _Part:
    """Part of a draft: its body, and the source of its document."""

    body: Tree
    content: PreparedDocument | StoredDocument


def _load_parts(tx: Transaction, draft: Draft) -> dict[str, _Part]:
    specs = PARTS[draft.kind]
    loaded = {}
    for part, content in draft.parts.items():
        if part not in specs:
            raise InvalidProblem(f"A {draft.kind} has no part {part!r}; it has {', '.join(specs)}.", code="no-part")
        if isinstance(content, StoredDocument):
            loaded[part] = _Part(documents.load_body(tx, content.digest), content)
        else:
            prepared = documents.prepared(content, schema=specs[part].schema)
            loaded[part] = _Part(prepared.body, prepared)
    return loaded


@dataclass(frozen=True)
class _Head:
    """Item with the documents of its newest revision."""

    id: str
    number: int
    parts: dict[str, str]


@dataclass
class _Publication:
    """Publication of several drafts in one transaction, one after another."""

    tx: Transaction
    project: ProjectRow
    author_id: str | None
    job_id: str | None
    done: dict[str, Published] = field(default_factory=dict)
    _collection_ids: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._references = references.ReferenceCheck(self.tx, self.project)

    def add(self, draft: Draft, loaded: Mapping[str, _Part], *, resolve: bool) -> None:
        digests: dict[str, str] = {}
        bodies: dict[str, Tree] = {}
        for part in (part for part in PARTS[draft.kind] if part in loaded):
            held = loaded[part]
            body = references.resolved(held.body, self.done) if resolve else held.body
            if draft.kind is Kind.MODEL and part == "tree":
                body = references.with_model_digest(body, digests.get("model"))
            digests[part] = self._store(held, body)
            bodies[part] = body
        self._references.require(draft.kind, bodies)
        for _ in range(_RACES):
            head = self._find(draft, digests)
            if head is None:
                published = self._create(draft, digests, bodies)
            elif draft.reuse == "by_content" or digests.items() <= head.parts.items():
                published = Published(draft.name_in_batch, head.id, draft.kind, head.number, False)
            else:
                published = self._revise(draft, head, digests, bodies)
            if published is not None:
                self.done[draft.name_in_batch] = published
                return
        raise ConflictProblem(f"{draft.item_name!r} is being changed by other requests; try again.", code="contended")

    def _store(self, held: _Part, body: Tree) -> str:
        changed = body != held.body
        if isinstance(held.content, StoredDocument):
            digest = held.content.digest
            return documents.store_variant(self.tx, digest, body) if changed else digest
        return documents.store_document(self.tx, documents.with_body(held.content, body) if changed else held.content)

    # -- finding -------------------------------------------------------------------------------------------------------

    def _find(self, draft: Draft, digests: Mapping[str, str]) -> _Head | None:
        if draft.reuse == "new":
            return None
        statement = select(item.c.id, item.c.head).where(
            item.c.project_id == self.project.id, item.c.kind == draft.kind.value, item.c.deleted_us.is_(None)
        )
        if draft.reuse == "by_name":
            statement = statement.where(
                item.c.collection_id == self._collection_id(draft.collection), item.c.name == draft.item_name
            )
        else:
            self.tx.lock(f"content:{self.project.id}:{draft.kind}")
            for part, spec in PARTS[draft.kind].items():
                if spec.required:
                    named = revision_part.alias(f"part_{part}")
                    statement = statement.join(
                        named, and_(named.c.item_id == item.c.id, named.c.number == item.c.head, named.c.part == part)
                    ).where(named.c.document_digest == digests.get(part))
        row = self.tx.execute(statement.order_by(item.c.id).limit(1)).first()
        return None if row is None else _Head(row.id, row.head, read_part_digests(self.tx, row.id, row.head))

    def _collection_id(self, path: str) -> str:
        if path not in self._collection_ids:
            self._collection_ids[path] = collections.ensure(self.tx, self.project, path)
        return self._collection_ids[path]

    # -- writing -------------------------------------------------------------------------------------------------------

    def _create(self, draft: Draft, digests: Mapping[str, str], bodies: Mapping[str, Tree]) -> Published | None:
        lacking = [part for part, spec in PARTS[draft.kind].items() if spec.required and part not in digests]
        if lacking:
            raise InvalidProblem(f"A {draft.kind} needs the part {lacking[0]!r}.", code="part-required")
        summary = summarise(draft.kind, bodies)
        row = {
            "id": new_id(draft.kind.value), "project_id": self.project.id, "kind": draft.kind.value, "head": 1,
            "collection_id": self._collection_id(draft.collection), "created_us": self.tx.now_us,
            "updated_us": self.tx.now_us, "summary": summary.shown, "frames": summary.frames,
            "skeleton_id": summary.skeleton_id,
        }  # fmt: skip
        for name in _names(draft):
            named = row | {"name": name, "name_folded": name.casefold()}
            made = self.tx.execute(self.tx.insert_or_ignore(item, named).returning(item.c.id)).scalar()
            if made is not None:
                self._write_revision(draft, made, 1, digests)
                self._emit("item.created", draft, made, 1)
                return Published(draft.name_in_batch, made, draft.kind, 1, True)
        if draft.reuse == "new":
            place = f"{draft.collection}/{draft.item_name}" if draft.collection else draft.item_name
            raise ConflictProblem(f"There is a {draft.kind} {place!r} already.", code="name-taken")
        return None

    def _revise(
        self, draft: Draft, head: _Head, digests: Mapping[str, str], bodies: Mapping[str, Tree]
    ) -> Published | None:
        parts = {**head.parts, **digests}
        if not write_head(self.tx, draft.kind, head.id, parts, bodies, item.c.head == head.number):
            return None
        self._write_revision(draft, head.id, head.number + 1, parts)
        self._emit("item.revised", draft, head.id, head.number + 1)
        return Published(draft.name_in_batch, head.id, draft.kind, head.number + 1, True)

    def _write_revision(self, draft: Draft, item_id: str, number: int, parts: Mapping[str, str]) -> None:
        write_revision(self.tx, item_id, number, parts, self.author_id, draft.message, self.job_id)
        tags = [{"item_id": item_id, "tag": tag} for tag in dict.fromkeys(draft.tags)]
        if tags:
            self.tx.execute(self.tx.insert_or_ignore(item_tag), tags)
        sources = [
            {
                "item_id": item_id, "number": number, "role": role, "position": position,
                "input_item_id": source, "input_number": source_number, "job_id": self.job_id,
            }
            for role, pinned in draft.sources.items()
            for position, (source, source_number) in enumerate(pinned)
        ]  # fmt: skip
        if sources:
            self.tx.execute(insert(lineage), sources)

    def _emit(self, kind: str, draft: Draft, item_id: str, number: int) -> None:
        self.tx.emit(
            kind, item_id, project_id=self.project.id, item_kind=draft.kind.value, name=draft.item_name,
            collection=draft.collection, revision=number, job=self.job_id,
        )  # fmt: skip


def _names(draft: Draft) -> Iterator[str]:
    """Yield names to try for a new item: its own, and numbered ones if the draft is identified by its content."""
    yield draft.item_name
    if draft.reuse == "by_content":
        for number in itertools.count(2):
            yield f"{draft.item_name[:240]}-{number}"
