"""Manifests of folders: which version a folder has, and which part of the version was checked out there.

If a whole version is checked out, `dataset.folder_commit` is the digest of its commit. If only a part was checked out,
`dataset.folder_commit` is the digest of a chunk that contains a manifest. The manifest names a tree of the entries that
were checked out. A commit compares the folder with this tree, so the other entries of the version do not count as
removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Row, and_, select

from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.tables import dataset, dataset_commit
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.tree.chunks import Chunk, DamagedChunk, Leaf, encode
from marey_versions.tree.reading import ChunkReader

_KEY = "manifest"
_IS_COMMIT = and_(dataset_commit.c.dataset_id == dataset.c.id, dataset_commit.c.digest == dataset.c.folder_commit)


@dataclass(frozen=True)
class FolderManifest:
    """Version that is checked out in a folder, and the selection if only a part of the version is checked out."""

    commit: str
    tree: str
    """Digest of the root of the tree of the entries that were checked out."""
    query: str | None = None
    paths: Sequence[str] = ()

    @property
    def partial(self) -> bool:
        """Whether the folder has only the entries that a query or paths select."""
        return self.query is not None or bool(self.paths)

    @property
    def shown(self) -> dict[str, Any]:
        """The commit and the selection as a JSON object, for the context of errors."""
        return {"commit": self.commit, "query": self.query, "paths": list(self.paths)}


def read_manifest(tx: Transaction, found: Row[Any]) -> FolderManifest | None:
    """Return the manifest of a dataset's folder; None if no version was checked out or committed there yet."""
    return read_manifests(tx, [found]).get(found.id)


def read_manifests(tx: Transaction, rows: Sequence[Row[Any]]) -> dict[str, FolderManifest]:
    """Return the manifests of the folders of datasets, by id of the dataset; folders without one are left out."""
    named = {row.id: row.folder_commit for row in rows if row.folder_commit is not None}
    found: dict[str, FolderManifest] = {}
    for some in in_lists(sorted(named)):
        whole = select(dataset.c.id, dataset_commit.c.digest, dataset_commit.c.tree).join(dataset_commit, _IS_COMMIT)
        for row in tx.execute(whole.where(dataset.c.id.in_(some))):
            found[row.id] = FolderManifest(row.digest, row.tree)
    reader = ChunkReader(StoredChunks(tx))
    partial = sorted(named.keys() - found.keys())
    for of, chunk in zip(partial, reader.several([named[one] for one in partial]), strict=True):
        found[of] = _manifest_in(chunk)
    return found


def _manifest_in(chunk: Chunk) -> FolderManifest:
    """Return the manifest that a chunk contains. Raises `DamagedChunk` if the chunk contains no valid manifest."""
    value = dict(chunk.entries).get(_KEY) if isinstance(chunk, Leaf) else None
    if value is None or value.keys() != {"commit", "query", "paths", "tree"}:
        raise DamagedChunk("the chunk does not contain the manifest of a folder")
    texts = [value["commit"], value["tree"], *(value["paths"] if type(value["paths"]) is list else [None])]
    if not all(isinstance(one, str) for one in texts) or not isinstance(value["query"], str | None):
        raise DamagedChunk("a member of the manifest of a folder has another type")
    return FolderManifest(**value)


def store_manifest(tx: Transaction, manifest: FolderManifest) -> str:
    """Store the manifest of a folder, and return the value of `dataset.folder_commit` that refers to it."""
    if not manifest.partial:
        return manifest.commit
    digest, data = encode(Leaf(((_KEY, {**manifest.shown, "tree": manifest.tree}),)))
    store_chunks(tx, {digest: data})
    return digest


def roots_of_folders(tx: Transaction, *conditions: ColumnElement[bool]) -> set[str]:
    """Return the digests of the root chunks that the folders' manifests need, for datasets that meet the conditions.

    These are the chunks that contain a manifest, and the roots of the trees of the entries that were checked out.
    """
    partial = (
        select(dataset.c.id, dataset.c.folder_commit)
        .outerjoin(dataset_commit, _IS_COMMIT)
        .where(dataset.c.folder_commit.is_not(None), dataset_commit.c.digest.is_(None), *conditions)
    )
    rows = tx.execute(partial).all()
    manifests = read_manifests(tx, rows)
    return {root for row in rows for root in (row.folder_commit, manifests[row.id].tree)}
