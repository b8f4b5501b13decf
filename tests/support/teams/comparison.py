"""Comparison of a server with the model: branches, versions, logs, items, and the bytes of documents and files."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import select
from tests.support.teams.contents import (
    Content,
    Info,
    content_digest,
    files_of,
    part_digests,
    portable,
    same_document,
)
from tests.support.teams.model import Model
from tests.support.teams.operations import Clients
from tests.support.teams.three_way import changed_entries
from tests.support.teams.transfers import LISTED

from marey_client.archives.contents import read_documents
from marey_client.handles.versions import DatasetHandle
from marey_schemas.datasets.contents import RequestedDocument
from marey_schemas.datasets.naming import RefKind
from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.tables import blob
from marey_server.store.transaction import Transaction


class Comparison:
    """Comparison of the project on one server with the model, through a client."""

    def __init__(self, model: Model, lab: str, clients: Clients) -> None:
        self._model = model
        self._lab = lab
        self._clients = clients
        self._project = model.projects[lab]

    def refs(self) -> None:
        """Compare the branches and tags of all datasets."""
        for name, dataset in self._project.datasets.items():
            found = list(self._handle(name).refs())
            assert {one.name: one.commit for one in found} == dataset.refs, f"{self._lab}/{name}"
            assert {one.name for one in found if one.kind is RefKind.TAG} == dataset.tags

    def version(self, name: str, digest: str) -> None:
        """Compare the commit, the entries and the log of a version; each entry's content must be that of an item."""
        handle, made = self._handle(name), self._model.commits[digest]
        commit = handle.at(digest)
        assert (commit.digest, commit.parents, commit.author) == (digest, made.parents, made.author)
        self._model.note_tree(made.state, commit.tree)
        shown = list(handle.entries(digest))
        found = {(one.path, one.kind): (one.parts, frozenset(one.tags)) for one in shown}
        wanted = {key: (part_digests(one.parts), one.tags) for key, one in made.state.items()}
        assert found == wanted, f"{self._lab}/{name}@{digest}"
        lost = [one.path for one in shown if one.item is None]
        assert not lost, f"entries of {name}@{digest} have lost their items: {lost}"
        assert [one.digest for one in handle.log(digest)] == self._model.first_parents(digest)

    def contents_are_there(self) -> None:
        """Check that an item exists for each entry of each version."""
        for name, dataset in self._project.datasets.items():
            trees = {frozenset(self._model.commits[digest].state.items()): digest for digest in sorted(dataset.commits)}
            for digest in trees.values():
                lost = [one.path for one in self._handle(name).entries(digest) if one.item is None]
                assert not lost, f"entries of {name}@{digest} have lost their items: {lost}"

    def difference(self, name: str, before: str, after: str) -> None:
        """Compare the number of entries that differ between two versions."""
        found = self._handle(name).difference(before, after)
        assert len(found.entries) == changed_entries(self._model.state(before), self._model.state(after))

    def items(self) -> None:
        """Compare the present items of all kinds, apart from those that copies create in the folder `imported`."""
        project = self._clients.project(self._lab)
        for kind in LISTED:
            found = {
                one.id: (one.path, one.item.revision, frozenset(one.item.tags))
                for one in project.items(kind).list()
                if not one.path.startswith("imported/")
            }
            present = [one for one in self._project.present() if one.kind is kind]
            assert found == {one.id: (one.key[0], len(one.revisions), one.tags) for one in present}, self._lab

    def everything(self) -> None:
        """Compare all branches, tags and versions of all datasets, the documents of all entries, and the items."""
        self.refs()
        self.items()
        for name, dataset in self._project.datasets.items():
            for digest in sorted(dataset.commits):
                self.version(name, digest)
        self.documents(self._model.committed(self._lab))

    # -- bytes ------------------------------------------------------------------------------------------------------

    def documents(self, contents: Iterable[Content]) -> None:
        """Compare documents and files of versions, in the form that servers exchange."""
        wanted = [(content, part, value) for content in contents for part, value in content.parts]
        places = [RequestedDocument(content=content_digest(content), part=part) for content, part, _ in wanted]
        project = self._clients.project(self._lab)
        found = read_documents(project.transport, project.url, places)
        for (content, part, value), tree in zip(wanted, found, strict=True):
            assert same_document(tree, portable(value)), (content, part)
            if isinstance(value, Info) and value.file is not None:
                self._clients.servers[self._lab].blobs.fetch(value.file)  # compares the digest

    def files(self, database: Database, *, collected: bool) -> None:
        """Check that needed files are stored.

        `collected` states that all garbage was collected before; then files of purged items must be deleted.
        """
        every = [content for one in self._project.items.values() for content in one.revisions]
        kept = [content for one in self._project.items.values() if one.status != "purged" for content in one.revisions]
        kept += self._model.committed(self._lab)
        mentioned, here = (set[str]().union(*map(files_of, contents)) for contents in (every, kept))
        loose = self._project.loose_files.keys()
        stored = database.read(SYSTEM, _stored, sorted(mentioned | here | loose))
        assert here <= stored, "files that items or versions need are missing"
        assert loose <= stored, "uploaded files are missing before their time"
        if collected:
            assert not stored & (mentioned - self._model.needed_files()), "files of purged items are still stored"

    def _handle(self, name: str) -> DatasetHandle:
        return self._clients.dataset(self._lab, name)


def _stored(tx: Transaction, digests: list[str]) -> set[str]:
    return set(tx.execute(select(blob.c.digest).where(blob.c.digest.in_(digests))).scalars())
