"""Checkout of versions into the folders of datasets."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row, exists, select, update

from marey_schemas.access import Role
from marey_schemas.datasets.checkouts import CheckoutAnswer, CheckoutRequest
from marey_schemas.datasets.commits import MOST_CHANGES
from marey_schemas.items import ItemChange
from marey_schemas.kinds import Kind
from marey_schemas.lineage import RESTORED
from marey_schemas.names import MOST_TAGS
from marey_schemas.wording import counted
from marey_server.access.folder_rights import FolderRoleProblem
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import collections, items, projects
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.datasets.folders import FolderState, read_folder
from marey_server.store.datasets.history import revisions_with, tree_of
from marey_server.store.datasets.manifests import FolderManifest, read_manifest, store_manifest
from marey_server.store.datasets.naming import dataset_replaced, find_dataset, resolve
from marey_server.store.datasets.selecting import SelectedEntries
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.items import Draft, StoredDocument
from marey_server.store.items.facets import add_facets, facets_of_contents
from marey_server.store.items.revisions import StoredContent, read_part_digests
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges, require_no_purge_since
from marey_server.store.tables import collection, dataset, item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.compared import ComparedEntry, compare_entries
from marey_versions.records import DatasetEntry, RevisionKey
from marey_versions.tree.difference import Changed
from marey_versions.tree.reading import Tree


def check_out(
    tx: Transaction, project: str, name: str, request: CheckoutRequest, selected: SelectedEntries | None = None
) -> CheckoutAnswer:
    """Replace the content of a dataset's folder by a version, which becomes the parent of the folder's next commit.

    If the request selects a part of the version, `selected` is this part. The folder then has the selected entries
    only, and its next commits change no other entries.

    An item whose entry has moved or changed keeps its id. If the folder lacks an entry of the version, the deleted item
    of this entry is restored if possible; otherwise a new item is created.

    Raises `ForbiddenProblem` unless the caller is a maintainer in all folders of the dataset. Raises `InvalidProblem`
    if too many entries differ. Raises `ConflictProblem` if another request changes the folder, if the dataset was
    replaced since the entries were selected, or if the folder has uncommitted changes that the request does not
    discard.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    rights = rights_of_caller(tx, project_row)
    tx.lock(f"checkout {project_row.id} {name}")  # so that no other checkout changes the folder after it was read
    found = find_dataset(tx, project_row, name)
    rights.require_below(found.path or "", Role.MAINTAINER)
    manifest = _make_manifest(tx, project_row, found, request, selected)
    state = read_folder(tx, project_row, found)
    store = StoredChunks(tx)
    if not request.discard:
        _require_recorded(tx, found, state, store)
    wanted = Tree(store, manifest.tree)
    back = state.changes_since(wanted)
    targets = wanted.get_several(back)
    changes = [Changed(key, state.entries.get(key), targets.get(key)) for key in sorted(back)]
    if len(changes) > MOST_CHANGES:
        raise InvalidProblem(
            f"{counted(len(changes), 'entry')} of the folder differ from this version; a checkout changes at most "
            f"{MOST_CHANGES:,}. First check out a version between the folder's and this one. If the folder is almost "
            "empty, first check out a part of this version (`paths`), then larger parts.",
            code="large-checkout",
        )
    compared = compare_entries(changes)
    _require_possible(found, compared)
    _Checkout(tx, project_row, found, state).apply(compared)
    # A commit of the folder that is being recorded sees by `rev` that the folder has other content now.
    values = {"folder_commit": store_manifest(tx, manifest), "updated_us": tx.now_us, "rev": dataset.c.rev + 1}
    tx.execute(update(dataset).where(dataset.c.id == found.id).values(**values))
    counts = Counter(one.change for one in compared)
    return CheckoutAnswer(
        commit=manifest.commit, taken=len(wanted), entries=len(Tree(store, tree_of(tx, found.id, manifest.commit))),
        added=counts["added"], removed=counts["removed"], moved=counts["moved"], changed=counts["changed"],
    )  # fmt: skip


def _make_manifest(
    tx: Transaction,
    project_row: ProjectRow,
    found: Row[Any],
    request: CheckoutRequest,
    selected: SelectedEntries | None,
) -> FolderManifest:
    """Return the record (`FolderManifest`) of the version that the folder gets.

    If only a part of the version is checked out, also store the tree of this part.
    """
    if not request.partial:
        digest = resolve(tx, found.id, request.version)
        return FolderManifest(digest, tree_of(tx, found.id, digest))
    assert selected is not None, "entries are selected before they are checked out"
    if selected.dataset_id != found.id:
        raise dataset_replaced(found.name)
    require_no_purge_since(tx, project_row.id, selected.last_purge)
    store_chunks(tx, selected.chunks)
    return FolderManifest(selected.commit, selected.tree, request.query, request.paths)


def _require_recorded(tx: Transaction, found: Row[Any], state: FolderState, store: StoredChunks) -> None:
    manifest = read_manifest(tx, found)
    changed = state.entries if manifest is None else state.changes_since(Tree(store, manifest.tree))
    if changed:
        raise ConflictProblem(
            f"The folder {found.path!r} has changes that no commit has recorded; commit or discard them.",
            code="uncommitted-changes",
            context={"count": len(changed)},
            unnamed="The folder has changes that no commit has recorded; commit or discard them.",
        )


def _require_possible(found: Row[Any], compared: Sequence[ComparedEntry]) -> None:
    """Raise `InvalidProblem` if an entry cannot become an item: its folder is too long, or it has too many tags."""
    for entry in (one.after for one in compared if one.after is not None):
        collections.check_length(_folder_of(found, entry))
        if len(entry.tags) > MOST_TAGS:
            raise InvalidProblem(
                f"The entry at {entry.path!r} has {len(entry.tags)} tags; an item has at most {MOST_TAGS}. Commit the "
                "entry with fewer tags, or check out another version.",
                code="too-many-tags",
                unnamed=f"An entry has {len(entry.tags)} tags; an item has at most {MOST_TAGS}. Commit the entry with "
                "fewer tags, or check out another version.",
            )


def _folder_of(found: Row[Any], entry: DatasetEntry) -> str:
    """Return the path, in the project, of the folder that holds the item of an entry."""
    return "/".join(filter(None, (found.path, entry.path.rpartition("/")[0])))


@dataclass(frozen=True)
class _Checkout:
    """Checkout in progress."""

    tx: Transaction
    project: ProjectRow
    dataset: Row[Any]
    state: FolderState
    given: dict[str, str] = field(default_factory=dict)
    """Content digest of each item that gets a new revision, by the id of the item."""

    def apply(self, compared: Sequence[ComparedEntry]) -> None:
        """Change the folder, in an order that frees each path before an item is created there or moved there."""
        documents = self._documents(one.after for one in compared if one.after is not None)
        of_kind: defaultdict[str, list[ComparedEntry]] = defaultdict(list)
        for one in compared:
            of_kind[one.change].append(one)
        for one in of_kind["removed"]:
            self._delete(one)
        for one in of_kind["moved"]:
            self._place(one, f".{self._item(one)}")
        for one in of_kind["moved"]:
            self._place(one, None)
        for one in (*of_kind["moved"], *of_kind["changed"]):
            self._change(one, documents)
        for one in of_kind["added"]:
            self._add(one, documents)
        self._keep_facets()

    def _documents(self, entries: Iterable[DatasetEntry]) -> dict[str, StoredContent]:
        """Return, for the content digest of each entry, a revision that has this content.

        Raises `InvalidProblem` if the project does not have the content of an entry.
        """
        wanted = {entry.content: entry for entry in entries}
        held = revisions_with(self.tx, self.project.id, wanted)
        if lacking := sorted(wanted[content].path for content in wanted.keys() - held.keys()):
            raise InvalidProblem(
                f"The project has no item with the content of {counted(len(lacking), 'entry')} of the version; the "
                f"first is at {lacking[0]!r}. Commit an existing item to this path, or check out another version.",
                code="no-content",
                unnamed=f"The project has no item with the content of {counted(len(lacking), 'entry')} of the version. "
                "Check out another version.",
            )
        parts = read_part_digests(self.tx, set(held.values()))
        return {content: StoredContent(RevisionKey(*key), parts[key]) for content, key in held.items()}

    def _item(self, one: ComparedEntry) -> str:
        assert one.before is not None
        return str(self.state.items[one.before.key].id)

    def _delete(self, one: ComparedEntry) -> None:
        kind = Kind(one.present.kind)
        items.delete_item(self.tx, self.project.name, kind, self._item(one), expected_rev=None)

    def _place(self, one: ComparedEntry, temporary: str | None) -> None:
        name = one.present.path.rpartition("/")[2]
        change = ItemChange(name=temporary or name, collection=_folder_of(self.dataset, one.present))
        kind = Kind(one.present.kind)
        items.change_item(self.tx, self.project.name, kind, self._item(one), change, expected_rev=None)

    def _change(self, one: ComparedEntry, documents: Mapping[str, StoredContent]) -> None:
        assert one.after is not None
        kind, item_id = Kind(one.after.kind), self._item(one)
        if one.parts:
            source = documents[one.after.content]
            items.restore_content(self.tx, self.project, kind, item_id, source, self._message)
            self.given[item_id] = one.after.content
        if one.before is not None and set(one.before.tags) != set(one.after.tags):
            tags = ItemChange(tags=one.after.tags)
            items.change_item(self.tx, self.project.name, kind, item_id, tags, expected_rev=None)

    @property
    def _message(self) -> str:
        return f"Checkout of the dataset {self.dataset.name}"

    def _add(self, one: ComparedEntry, documents: Mapping[str, StoredContent]) -> None:
        assert one.after is not None
        kind = Kind(one.after.kind)
        source = documents[one.after.content]
        item_id = source.key.item
        name, folder = one.after.path.rpartition("/")[2], _folder_of(self.dataset, one.after)
        if self._can_restore(kind, item_id):
            items.restore_item(self.tx, self.project.name, kind, item_id)
            place = ItemChange(name=name, collection=folder, tags=one.after.tags)
            items.change_item(self.tx, self.project.name, kind, item_id, place, expected_rev=None)
            items.restore_content(self.tx, self.project, kind, item_id, source, self._message)
            self.given[item_id] = one.after.content
            return
        draft = Draft(
            name_in_batch="", kind=kind, item_name=name, collection=folder, tags=one.after.tags,
            parts={part: StoredDocument(digest) for part, digest in source.parts.items()}, reuse="new",
            message=self._message, sources={RESTORED: [source.key]},
        )  # fmt: skip
        (made,) = items.publish(
            self.tx, self.project, [draft], author_id=self.tx.principal.user_id,
            rights=rights_of_caller(self.tx, self.project), refer_to_deleted=True,
        )  # fmt: skip
        self.given[made.item] = one.after.content

    def _keep_facets(self) -> None:
        """Copy the facets of earlier revisions with the same content to the new revisions."""
        known = facets_of_contents(self.tx, self.project.id, self.given.values())
        measured = sorted(item_id for item_id, content in self.given.items() if content in known)
        for some in in_lists(measured):
            heads = self.tx.execute(select(item.c.id, item.c.head).where(item.c.id.in_(some)))
            add_facets(self.tx, [(row.id, row.head, known[self.given[row.id]]) for row in heads])

    def _can_restore(self, kind: Kind, item_id: str) -> bool:
        """Return whether an item is deleted and may be restored, and no other item has its former folder and name."""
        former = (
            select(item.c.name, collection.c.path, collection.c.deleted_us)
            .join(collection, collection.c.id == item.c.collection_id)
            .where(item.c.id == item_id, item.c.deleted_us.is_not(None))
        )
        row = self.tx.execute(former).first()
        if row is None:
            return False
        try:
            rights_of_caller(self.tx, self.project).require_restoration(row.path, row.deleted_us)
        except FolderRoleProblem:
            return False
        there = (
            exists()
            .where(item.c.collection_id == collection.c.id, collection.c.project_id == self.project.id)
            .where(collection.c.path == row.path, collection.c.deleted_us.is_(None))
            .where(item.c.kind == kind.value, item.c.name == row.name, item.c.deleted_us.is_(None))
        )
        return not self.tx.execute(select(there)).scalar()
