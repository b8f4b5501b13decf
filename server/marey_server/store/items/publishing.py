"""Publication of drafts: creates items and new revisions of items, many of them with few SQL statements."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Row, and_, insert, select

from marey_schemas.access import Role
from marey_schemas.documents.clips import with_earlier_facts
from marey_schemas.event_kinds import OrdinaryEventKind
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.sizes import batched
from marey_server import faults
from marey_server.access.folder_rights import FolderRights
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.prepared_documents import PreparedDocument, digest_of_body, with_body
from marey_server.store import collections, documents
from marey_server.store.ids import new_id
from marey_server.store.items import references
from marey_server.store.items.drafts import Draft, Published
from marey_server.store.items.loaded_drafts import LoadedDraft, load_drafts
from marey_server.store.items.revisions import NewRevision, read_part_digests, write_head, write_revisions
from marey_server.store.items.same_rigs import on_known_rigs
from marey_server.store.items.skeleton_changes import without_skeleton_changes
from marey_server.store.items.summaries import skeleton_of, summarise
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.quotas import holdings
from marey_server.store.quotas.holdings import ItemTotals
from marey_server.store.tables import item, item_tag, lineage, revision_part
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]

DRAFTS_TOGETHER = 256
"""Greatest number of drafts that are published together, with one set of SQL statements."""

_HEAD = (item.c.id, item.c.head, item.c.creator_id, item.c.skeleton_id)
"""Columns that are read of an item that a draft may use or revise."""

_RACES = 20
"""Greatest number of tries to publish a draft if concurrent writes interfere."""


def publish(
    tx: Transaction,
    project_row: ProjectRow,
    drafts: Sequence[Draft],
    *,
    author_id: str | None,
    rights: FolderRights | None,
    job_id: str | None = None,
    refer_to_deleted: bool = False,
) -> list[Published]:
    """Create items and revisions from drafts, all or none; return them in the order of the drafts.

    In a document, `{"output": name}` refers to the draft `name`, and is replaced by the item and revision published
    from this draft. In the sample tree of a model, `model_digest` may be such a reference, and is replaced by the
    digest of the draft's model. With `refer_to_deleted`, documents may refer to deleted items.

    If an item already has the content of a draft, no new revision is created. Drafts with `same_skeleton` that would
    change the skeleton of an existing item are left out, and are missing in the result (see `skeleton_changes`).
    `rights` are the rights of the user who publishes; they may be None only if all drafts are hidden.

    Raises `InvalidProblem` for a draft that is not valid, and `ConflictProblem` for a name that is taken. Raises
    `ForbiddenProblem` if `rights` do not allow writing to the folder of a new item or revision.
    """
    by_name = {draft.name_in_batch: draft for draft in drafts}
    if len(by_name) != len(drafts):
        twice = Counter(draft.name_in_batch for draft in drafts).most_common(1)[0][0]
        raise InvalidProblem(
            f"Two results in the request have the name {twice!r}; give each result another name.",
            code="duplicate-output",
        )
    hold_off_purges(tx, project_row.id)
    require_places((draft for draft in drafts if draft.reuse != "by_content"), rights)
    publication = _Publication(tx, project_row, author_id, rights, job_id, refer_to_deleted)
    loaded = on_known_rigs(tx, project_row, without_skeleton_changes(tx, project_row, load_drafts(tx, drafts)))
    for together in _in_turns(loaded):
        publication.add(together)
    holdings.count_added(tx, project_row.id, publication.added)
    faults.point("publish.before_commit")
    tx.after_commit(lambda: faults.point("publish.after_commit"))
    return [publication.done[draft.name_in_batch] for draft in drafts if draft.name_in_batch in publication.done]


def require_places(drafts: Iterable[Draft], rights: FolderRights | None) -> None:
    """Raise `ForbiddenProblem` unless `rights` allow writing to the folder of each draft that is not hidden."""
    for folder in sorted({draft.collection for draft in drafts if not draft.hidden}):
        if rights is None:
            raise TypeError("the argument `rights` may be None only if all drafts are hidden")
        rights.require(folder, Role.CONTRIBUTOR)


def _in_turns(loaded: Sequence[LoadedDraft]) -> Iterator[list[LoadedDraft]]:
    """Split drafts into groups that can be published together, each after all drafts that it refers to.

    The drafts of a group have the same kind, the same `reuse` and different places. Drafts with the same place keep
    their order.
    """
    by_name = {one.draft.name_in_batch: one for one in loaded}
    turns: dict[str, int] = {}
    next_turns: dict[Hashable, int] = {}
    groups: defaultdict[tuple[int, Kind, str], list[LoadedDraft]] = defaultdict(list)
    for name in references.in_order({name: one.refers for name, one in by_name.items()}):
        one = by_name[name]
        draft = one.draft
        place = (draft.kind, draft.collection, draft.item_name, name if draft.reuse == "by_content" else None)
        turn = max([turns[other] + 1 for other in one.refers if other in turns], default=0)
        turns[name] = turn = max(turn, next_turns.get(place, 0))
        next_turns[place] = turn + 1
        groups[turn, draft.kind, draft.reuse].append(one)
    for _, group in sorted(groups.items(), key=lambda named: named[0][0]):
        yield from batched(group, DRAFTS_TOGETHER)


@dataclass(frozen=True)
class _Ready:
    """A draft whose documents are stored."""

    draft: Draft
    digests: Mapping[str, str]
    bodies: Mapping[str, Tree]
    stored_bytes: Mapping[str, int]
    """Number of bytes that each part uses of a quota."""

    @property
    def required(self) -> tuple[str | None, ...]:
        """Digests of the parts that every item of the kind has."""
        return tuple(self.digests.get(part) for part in _required(self.draft.kind))

    def published(self, head: _Head, *, created: bool) -> Published:
        """Return the revision that was published from the draft; `head` has the previous skeleton of the item."""
        skeleton = skeleton_of(self.draft.kind, self.bodies)
        changed = (
            created and None not in (skeleton, head.skeleton_id) and (skeleton or {}).get("item") != head.skeleton_id
        )
        return Published(self.draft.name_in_batch, head.id, self.draft.kind, head.number, created, changed)


def _required(kind: Kind) -> list[str]:
    return [part for part, spec in PARTS[kind].items() if spec.required]


@dataclass(frozen=True)
class _Head:
    """Item of the project, and the digests of the documents of its newest revision."""

    id: str
    number: int
    parts: Mapping[str, str]
    creator_id: str | None
    skeleton_id: str | None = None


@dataclass
class _Publication:
    """Publication of groups of drafts, one group after another, each with a fixed small number of statements."""

    tx: Transaction
    project: ProjectRow
    author_id: str | None
    rights: FolderRights | None
    job_id: str | None
    refer_to_deleted: bool
    done: dict[str, Published] = field(default_factory=dict)
    added: dict[str | None, ItemTotals] = field(default_factory=dict)
    """Numbers of new items and of bytes added to new or existing items, by creator; hidden new items do not count."""
    _collection_ids: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._references = references.ReferenceCheck(self.tx, self.project, to_deleted=self.refer_to_deleted)

    def add(self, group: Sequence[LoadedDraft]) -> None:
        """Publish drafts that have the same kind, the same `reuse`, and different places."""
        kind, reuse = group[0].draft.kind, group[0].draft.reuse
        waiting = self._store(group)
        for one in waiting:
            self._references.require(kind, one.bodies)
        for _ in range(_RACES):
            heads = self._find(waiting, kind, reuse)
            new = [one for one in waiting if one.draft.name_in_batch not in heads]
            self._create(self._first_of_equals(new) if reuse == "by_content" else new, kind)
            for one in waiting:
                head = heads.get(one.draft.name_in_batch)
                if head is not None:
                    self._reuse(one, head)
                if (published := self.done.get(one.draft.name_in_batch)) is not None:
                    required = {part: body for part, body in one.bodies.items() if PARTS[kind][part].required}
                    self._references.know(published, required)
            waiting = [one for one in waiting if one.draft.name_in_batch not in self.done]
            if not waiting:
                return
        name = waiting[0].draft.item_name
        raise ConflictProblem(
            f"Other requests are changing the item {name!r} at the same time; try again.", code="contended"
        )

    def _store(self, group: Sequence[LoadedDraft]) -> list[_Ready]:
        """Store the documents of drafts, and return the drafts with the digests of their documents.

        References to drafts that were published before are replaced by references to their revisions.
        """
        fresh: list[PreparedDocument] = []
        variants: list[tuple[str, Tree]] = []
        stored = []
        for one in group:
            digests: dict[str, str] = {}
            bodies: dict[str, Tree] = {}
            for part, content in one.contents.items():
                body = references.resolved(one.bodies[part], self.done) if one.refers else one.bodies[part]
                if one.draft.kind is Kind.MODEL and part == "tree":
                    body = references.with_model_digest(body, digests.get("model"))
                changed = body != one.bodies[part]
                if one.draft.kind is Kind.GRAPH and changed:
                    body = references.with_imported_content(body, one.bodies[part])
                digest = content.digest
                if isinstance(content, PreparedDocument):
                    fresh.append(with_body(content, body) if changed else content)
                    digest = fresh[-1].digest
                elif changed:
                    variants.append((content.digest, body))
                    digest = digest_of_body(body)
                digests[part], bodies[part] = digest, body
            stored.append((one.draft, digests, bodies))
        sizes = documents.store_documents(self.tx, fresh)
        documents.store_variants(self.tx, variants)
        known = {digest for _, digests, _ in stored for digest in digests.values() if digest not in sizes}
        sizes |= documents.stored_bytes_of(self.tx, known)
        return [
            _Ready(draft, digests, bodies, {part: sizes[digest] for part, digest in digests.items()})
            for draft, digests, bodies in stored
        ]

    # -- finding -------------------------------------------------------------------------------------------------------

    def _find(self, waiting: Sequence[_Ready], kind: Kind, reuse: str) -> dict[str, _Head]:
        """Return the existing items that drafts will use or revise, by the names of the drafts.

        With `by_name`, an item is found by its place (folder and name). With `by_content`, it is found by the documents
        of its required parts. With `new`, none is found.
        """
        if reuse == "new":
            return {}
        found = self._find_places(waiting, kind) if reuse == "by_name" else self._find_contents(waiting, kind)
        parts = read_part_digests(self.tx, {(row.id, row.head) for row in found.values()})
        return {
            name: _Head(row.id, row.head, parts[row.id, row.head], row.creator_id, row.skeleton_id)
            for name, row in found.items()
        }

    def _find_places(self, waiting: Sequence[_Ready], kind: Kind) -> dict[str, Row[Any]]:
        folders: defaultdict[str, dict[str, str]] = defaultdict(dict)
        for one in waiting:
            folders[self._collection_id(one.draft.collection)][one.draft.item_name] = one.draft.name_in_batch
        found = {}
        for collection_id, names in folders.items():
            statement = select(*_HEAD, item.c.name).where(
                item.c.collection_id == collection_id, item.c.kind == kind.value, item.c.deleted_us.is_(None)
            )
            for row in self.tx.execute(statement.where(item.c.name.in_(list(names)))):
                found[names[row.name]] = row
        return found

    def _find_contents(self, waiting: Sequence[_Ready], kind: Kind) -> dict[str, Row[Any]]:
        """Return, by name of the draft, the row of the first item of the project that has the same required parts."""
        self.tx.lock(f"content:{self.project.id}:{kind}")
        statement = select(*_HEAD).where(
            item.c.project_id == self.project.id, item.c.kind == kind.value, item.c.deleted_us.is_(None)
        )
        named = []
        for place, part in enumerate(_required(kind)):
            held = revision_part.alias(f"part_{part}")
            at_head = and_(held.c.item_id == item.c.id, held.c.number == item.c.head, held.c.part == part)
            wanted = {digest for one in waiting if (digest := one.required[place]) is not None}
            statement = statement.join(held, at_head).where(held.c.document_digest.in_(sorted(wanted)))
            named.append(held.c.document_digest.label(f"digest_{place}"))
        rows: dict[tuple[str | None, ...], Row[Any]] = {}
        for row in self.tx.execute(statement.add_columns(*named).order_by(item.c.id)):
            rows.setdefault(tuple(row[len(_HEAD) :]), row)
        return {one.draft.name_in_batch: rows[one.required] for one in waiting if one.required in rows}

    @staticmethod
    def _first_of_equals(new: Sequence[_Ready]) -> list[_Ready]:
        """Return, of each group of drafts with equal content, the first; the others use the item that it creates."""
        firsts: dict[tuple[str | None, ...], _Ready] = {}
        for one in new:
            firsts.setdefault(one.required, one)
        return list(firsts.values())

    def _collection_id(self, path: str) -> str:
        if path not in self._collection_ids:
            self._collection_ids[path] = collections.ensure(self.tx, self.project, path)
        return self._collection_ids[path]

    # -- writing -------------------------------------------------------------------------------------------------------

    def _create(self, new: Sequence[_Ready], kind: Kind) -> None:
        """Create items for the drafts, if their names are free.

        Raises `ConflictProblem` if the name of a draft with `reuse="new"` is taken.
        """
        if not new:
            return
        require_places((one.draft for one in new), self.rights)
        for one in new:
            if None in one.required:
                lacking = _required(kind)[one.required.index(None)]
                raise InvalidProblem(
                    f"The part {lacking!r} is missing: every item of the kind {kind} needs it.", code="part-required"
                )
        ids = sorted(new_id(kind.value) for _ in new)  # in the order of the drafts
        rows = {item_id: self._row(one, item_id) for item_id, one in zip(ids, new, strict=True)}
        names = {item_id: _names(one.draft) for item_id, one in zip(ids, new, strict=True)}
        made: set[str] = set()
        insertion = self.tx.insert_or_ignore(item).returning(item.c.id)
        while named := {at: name for at in ids if at not in made and (name := next(names[at], None)) is not None}:
            given = [rows[at] | {"name": name, "name_folded": name.casefold()} for at, name in named.items()]
            made.update(self.tx.execute(insertion, given).scalars())
        created = [(one, at) for at, one in zip(ids, new, strict=True) if at in made]
        self._write("item.created", [(one, _Head(at, 1, one.digests, self.author_id)) for one, at in created])
        counted = [at for one, at in created if not one.draft.hidden]
        self._add(self.author_id, ItemTotals(len(counted), sum(rows[at]["stored_bytes"] for at in counted)))
        for one in new:
            if one.draft.reuse == "new" and one.draft.name_in_batch not in self.done:
                place = "/".join(filter(None, (one.draft.collection, one.draft.item_name)))
                raise ConflictProblem(
                    f"There is already a {kind} {place!r}; choose another name, or change the existing item.",
                    code="name-taken",
                    unnamed=f"There is already a {kind} with this folder and name; choose another name, or change the "
                    "existing item.",
                )

    def _row(self, one: _Ready, item_id: str) -> dict[str, Any]:
        summary = summarise(one.draft.kind, one.bodies)
        return {
            "id": item_id, "project_id": self.project.id, "kind": one.draft.kind.value, "head": 1,
            "collection_id": self._collection_id(one.draft.collection), "created_us": self.tx.now_us,
            "updated_us": self.tx.now_us, "summary": summary.shown, "frames": summary.frames,
            "skeleton_id": summary.skeleton_id, "creator_id": self.author_id,
            "stored_bytes": sum(one.stored_bytes.values()), "deleted_us": self.tx.now_us if one.draft.hidden else None,
        }  # fmt: skip

    def _reuse(self, one: _Ready, head: _Head) -> None:
        """Use the existing item if it has the content of the draft; otherwise add a revision to it.

        Does nothing if another write has changed the item since `head` was read; `add` then tries again.
        """
        if one.draft.kind is Kind.CLIP and one.draft.reuse == "by_name":
            one = self._with_earlier_facts(one, head)
        if one.draft.reuse == "by_content" or one.digests.items() <= head.parts.items():
            self.done[one.draft.name_in_batch] = one.published(head, created=False)
            return
        parts = {**head.parts, **one.digests}
        added = sum(size for part, size in one.stored_bytes.items() if one.digests[part] != head.parts.get(part))
        unchanged = item.c.head == head.number
        if write_head(self.tx, one.draft.kind, head.id, parts, one.bodies, unchanged, added_bytes=added):
            self._write("item.revised", [(one, replace(head, number=head.number + 1, parts=parts))])
            self._add(head.creator_id, ItemTotals(stored_bytes=added))

    def _with_earlier_facts(self, one: _Ready, head: _Head) -> _Ready:
        """Return the draft of a clip, with empty facts about the recording filled in from the existing clip.

        So a second import of a file does not remove the consent of the performer.
        """
        digest, earlier = one.digests.get("info"), head.parts.get("info")
        if digest is None or earlier is None or digest == earlier:
            return one
        body = with_earlier_facts(one.bodies["info"], documents.load_body(self.tx, earlier))
        if body == one.bodies["info"]:
            return one
        documents.store_variants(self.tx, [(digest, body)])
        kept = {**one.digests, "info": digest_of_body(body)}
        return replace(one, digests=kept, bodies={**one.bodies, "info": body})

    def _add(self, creator_id: str | None, more: ItemTotals) -> None:
        self.added[creator_id] = self.added.get(creator_id, ItemTotals()) + more

    def _write(self, event: OrdinaryEventKind, made: Sequence[tuple[_Ready, _Head]]) -> None:
        """Insert new revisions, which become the newest of their items, with their tags, sources and events."""
        if not made:
            return
        revisions = [NewRevision(head.id, head.number, head.parts, one.draft.message) for one, head in made]
        write_revisions(self.tx, revisions, author_id=self.author_id, job_id=self.job_id)
        tags = [{"item_id": head.id, "tag": tag} for one, head in made for tag in dict.fromkeys(one.draft.tags)]
        if tags:
            self.tx.execute(self.tx.insert_or_ignore(item_tag), tags)
        sources = [
            {
                "item_id": head.id, "number": head.number, "role": role, "position": position,
                "input_item_id": source, "input_number": source_number, "job_id": self.job_id,
            }
            for one, head in made
            for role, pinned in one.draft.sources.items()
            for position, (source, source_number) in enumerate(pinned)
        ]  # fmt: skip
        if sources:
            self.tx.execute(insert(lineage), sources)
        shown = [(one, head) for one, head in made if not one.draft.hidden]
        self.tx.emit_each((event, self.project.id, head.id, self._event(one.draft, head)) for one, head in shown)
        for one, head in made:
            self.done[one.draft.name_in_batch] = one.published(head, created=True)

    def _event(self, draft: Draft, head: _Head) -> dict[str, Any]:
        return {
            "item_kind": draft.kind.value, "name": draft.item_name, "collection": draft.collection,
            "revision": head.number, "job": self.job_id,
        }  # fmt: skip


def _names(draft: Draft) -> Iterator[str]:
    """Yield the names to try for a new item, until one is free.

    The first is the name of the draft. A draft with `reuse="by_content"` may get another name, because an item with
    other content may have its name. So numbered names follow for it without end: `walk-2`, `walk-3` and so on.
    """
    yield draft.item_name
    if draft.reuse == "by_content":
        for number in itertools.count(2):
            yield f"{draft.item_name[:240]}-{number}"
