"""Search for the contents of revisions in all versions of the datasets of a project."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from sqlalchemy import and_, func, select

from marey_schemas.datasets.naming import RefKind
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.purges import DatasetHolder
from marey_server.store.datasets.chunks import StoredChunks
from marey_server.store.tables import dataset, dataset_commit, dataset_ref, proposal
from marey_server.store.transaction import Transaction
from marey_versions.records import entry_of
from marey_versions.tree.chunks import Branch, DamagedChunk, Entry, decode_trusted

_AT_ONCE = 200
_NOTHING: frozenset[str] = frozenset()


class _Version(NamedTuple):
    """Commit of a dataset."""

    dataset_id: str
    commit: str


class VersionSearch:
    """Search for contents of revisions in the trees of all commits of a project.

    The nodes of a tree are stored as chunks. Each chunk is read once, although many trees share it. A second `update`,
    in a later transaction, reads only the chunks of commits that were added in the meantime.
    """

    def __init__(self, project_id: str, wanted: Mapping[str, Collection[str]]) -> None:
        self._project_id = project_id
        self.wanted = wanted
        """Content digests of the parts of each revision, by the content digest of the revision."""
        self._parts = frozenset(part for parts in wanted.values() for part in parts)
        self._roots: dict[_Version, str] = {}
        self._below: dict[str, frozenset[str]] = {}
        """Digests of the wanted contents in a chunk and all chunks below it, by the digest of the chunk."""

    def update(self, tx: Transaction) -> None:
        """Search the commits that were not searched yet, and forget commits that no longer exist."""
        if not self.wanted:
            return
        statement = select(dataset_commit.c.dataset_id, dataset_commit.c.digest, dataset_commit.c.tree)
        statement = statement.join(dataset, dataset.c.id == dataset_commit.c.dataset_id)
        rows = tx.execute(statement.where(dataset.c.project_id == self._project_id))
        self._roots = {_Version(row.dataset_id, row.digest): row.tree for row in rows}
        self._search(StoredChunks(tx), set(self._roots.values()) - self._below.keys())

    def _search(self, store: StoredChunks, roots: Collection[str]) -> None:
        """Search the chunks below `roots` level by level, then collect the found contents from the leaves to the roots.

        Raises `DamagedChunk` if a chunk is missing.
        """
        children: dict[str, tuple[str, ...]] = {}
        waiting = set(roots)
        while waiting:
            batch = [waiting.pop() for _ in range(min(len(waiting), _AT_ONCE))]
            loaded = store.load(batch)
            for digest in batch:
                if digest not in loaded:
                    raise DamagedChunk(f"the chunk {digest} is missing")
                chunk = decode_trusted(digest, loaded[digest])
                if isinstance(chunk, Branch):
                    children[digest] = tuple(child.digest for child in chunk.children)
                    waiting.update(set(children[digest]) - self._below.keys() - children.keys())
                else:
                    self._below[digest] = self._found_in(chunk.entries)
        for digest in roots:
            self._gather(digest, children)

    def _gather(self, digest: str, children: Mapping[str, tuple[str, ...]]) -> frozenset[str]:
        if digest not in self._below:
            found = [self._gather(child, children) for child in children[digest]]
            self._below[digest] = _NOTHING.union(*found) if any(found) else _NOTHING
        return self._below[digest]

    def _found_in(self, entries: Iterable[Entry]) -> frozenset[str]:
        try:  # `entry_of` would check each entry, but few of them have a wanted part
            near = [entry for entry in entries if not self._parts.isdisjoint(entry[1]["parts"].values())]
        except (KeyError, AttributeError, TypeError) as error:
            raise DamagedChunk(f"the parts of an entry are missing, or are not strings: {error!r}") from error
        return frozenset(entry_of(*one).content for one in near) & self.wanted.keys() if near else _NOTHING

    def holders(self, tx: Transaction, contents: Mapping[str, Collection[str]]) -> dict[str, list[DatasetHolder]]:
        """Return, by the id of an item, the datasets of which a version contains the item.

        `contents` maps the ids of items to the content digests of their revisions.
        """
        containing: dict[str, dict[str, set[str]]] = {}
        items_of: dict[str, set[str]] = {}
        for item_id, digests in contents.items():
            for digest in digests:
                items_of.setdefault(digest, set()).add(item_id)
        for version, root in self._roots.items():
            for item_id in {one for content in self._below[root] for one in items_of.get(content, ())}:
                containing.setdefault(item_id, {}).setdefault(version.dataset_id, set()).add(version.commit)
        named = _Names(tx, {one for found in containing.values() for one in found})
        return {
            item_id: sorted((named.holder(*one) for one in found.items()), key=lambda holder: holder.dataset)
            for item_id, found in containing.items()
        }


class _Names:
    """Names of datasets, and the branches, tags and open proposals that refer to commits of the datasets."""

    def __init__(self, tx: Transaction, ids: Collection[str]) -> None:
        chosen = sorted(ids)
        datasets = select(dataset.c.id, dataset.c.name, dataset.c.deleted_us).where(dataset.c.id.in_(chosen))
        self._datasets = {row.id: row for row in tx.execute(datasets)} if ids else {}
        refs = select(dataset_ref).where(dataset_ref.c.dataset_id.in_(chosen)).order_by(dataset_ref.c.name)
        self._refs = tx.execute(refs).all() if ids else []
        self._proposals = tx.execute(_PROPOSALS.where(proposal.c.dataset_id.in_(chosen))).all() if ids else []

    def holder(self, dataset_id: str, commits: Collection[str]) -> DatasetHolder:
        """Return a dataset as a holder of an item; `commits` are the commits of the dataset that contain the item.

        The result names the branches, tags and open proposals that refer to one of these commits.
        """
        refs = [row for row in self._refs if row.dataset_id == dataset_id and row.digest in commits]
        proposals = [row for row in self._proposals if row.dataset_id == dataset_id and row.head_now in commits]
        return DatasetHolder(
            dataset=self._datasets[dataset_id].name,
            deleted=self._datasets[dataset_id].deleted_us is not None,
            branches=tuple(row.name for row in refs if row.kind == RefKind.BRANCH),
            tags=tuple(row.name for row in refs if row.kind != RefKind.BRANCH),
            proposals=tuple(row.number for row in proposals),
            commits=len(commits),
        )


_SOURCE = dataset_ref.alias("source")
_FOLLOWED = and_(
    _SOURCE.c.dataset_id == proposal.c.dataset_id, _SOURCE.c.name == proposal.c.source, proposal.c.head.is_(None)
)
_PROPOSALS = (
    select(proposal.c.dataset_id, proposal.c.number, func.coalesce(proposal.c.head, _SOURCE.c.digest).label("head_now"))
    .outerjoin(_SOURCE, _FOLLOWED)
    .where(proposal.c.state == ProposalState.OPEN.value)
    .order_by(proposal.c.number)
)
