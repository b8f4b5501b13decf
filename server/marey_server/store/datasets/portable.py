"""Content of versions for archives and other servers: documents contain no ids of this server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select

from marey_schemas.access import Role
from marey_schemas.datasets.contents import ContentsRequest, ExportCheck, ExportPermission, PartOfContent
from marey_schemas.documents.blob_references import members_of
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.partial_arrays import tile_digests
from marey_server.store import documents, projects
from marey_server.store.datasets.contents import Contents, find_contents_of
from marey_server.store.datasets.history import revisions_with
from marey_server.store.datasets.naming import find_dataset
from marey_server.store.items.consents import find_ended_with, record_override, require_consent
from marey_server.store.items.facets import facets_of_contents
from marey_server.store.items.reading import MOST_BYTES_AT_ONCE
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import document, item
from marey_server.store.transaction import Transaction
from marey_versions.records import RevisionKey, portable_document, references_in


def check_export(tx: Transaction, project: str, name: str, request: ExportCheck) -> ExportPermission:
    """Check that revisions of a dataset may be exported.

    Clips whose consent has ended may be exported if the request allows it; an event then names them. Raises
    `ConflictProblem` if the consent has ended and the request does not allow the export. The request may allow it only
    for a maintainer or an owner with the scope `write`; for others, raises `ForbiddenProblem`.
    """
    role = Role.MAINTAINER if request.allow_expired_consent else Role.READER
    project_row = projects.require(tx, project, at_least=role)
    if request.allow_expired_consent:
        projects.require_scope(tx, project, "write")
        hold_off_purges(tx, project_row.id)  # because the record names clips
    found = find_dataset(tx, project_row, name)
    ended = find_ended_with(tx, project_row.id, request.contents)
    if not request.allow_expired_consent:
        require_consent(ended)
    elif ended:
        record_override(tx, project_row.id, found.id, request, ended)
    return ExportPermission(ended=tuple(one.item for one in ended))


@dataclass(frozen=True)
class LoadedContents:
    """Members of the answer to a request for contents, and the documents for whose arrays it lists the tiles."""

    members: Mapping[str, Any]
    tiled: Sequence[documents.Tree | None]


def contents_document(loaded: LoadedContents) -> dict[str, Any]:
    """Return the answer to a request for contents. It takes long for large arrays, so no transaction should be open."""
    return {**loaded.members, "tiles": [_tiles_of(tree) for tree in loaded.tiled]}


def load_contents(tx: Transaction, project: str, request: ContentsRequest) -> LoadedContents:
    """Load the requested revisions of a project by content digest, their facets, and documents with encoded arrays.

    A revision or document that the project does not have is None. If the documents together are too large, the list of
    documents ends early; it always contains the first one. The same applies to the list of the tiles of documents.
    """
    project_row = projects.require(tx, project)
    wanted = {*request.revisions, *(one.content for one in (*request.documents, *request.tiles))}
    held = {one: RevisionKey(*key) for one, key in revisions_with(tx, project_row.id, wanted).items()}
    contents = find_contents_of(tx, project_row.id, held.values())
    members = {
        "revisions": _described(tx, held, contents, request),
        "documents": _portable(tx, project_row.id, _loaded(tx, held, request.documents)),
        "facets": _facets(tx, project_row.id, request),
    }
    return LoadedContents(members, tiled=_loaded(tx, held, request.tiles))


def _facets(tx: Transaction, project_id: str, request: ContentsRequest) -> list[dict[str, float]]:
    """Return the facets of each requested revision."""
    found = facets_of_contents(tx, project_id, request.revisions)
    return [found.get(one, {}) for one in request.revisions]


def _described(
    tx: Transaction, held: Mapping[str, RevisionKey], contents: Contents, request: ContentsRequest
) -> list[dict[str, Any] | None]:
    """Return, for each requested revision, its kind and the content digests of its parts, or None if it is missing."""
    keys = {one: held[one] for one in request.revisions if one in held}
    ids = sorted({key.item for key in keys.values()})
    kinds = {row.id: row.kind for row in tx.execute(select(item.c.id, item.c.kind).where(item.c.id.in_(ids)))}
    return [
        {"kind": kinds[keys[one].item], "parts": contents.parts[keys[one]]} if one in keys else None
        for one in request.revisions
    ]


def _loaded(
    tx: Transaction, held: Mapping[str, RevisionKey], places: Sequence[PartOfContent]
) -> list[documents.Tree | None]:
    """Load the documents at `places`, as many as fit into an answer; None stands for one that does not exist."""
    parts = read_part_digests(tx, {held[one.content] for one in places if one.content in held})
    digests = [parts[held[one.content]].get(one.part) if one.content in held else None for one in places]
    present = sorted({digest for digest in digests if digest is not None})
    sizes = {
        row.digest: row.size_bytes
        for row in tx.execute(select(document.c.digest, document.c.size_bytes).where(document.c.digest.in_(present)))
    }
    chosen = _that_fit(digests, sizes)
    loaded = documents.load_documents(tx, {digest for digest in chosen if digest is not None})
    return [None if digest is None else loaded[digest] for digest in chosen]


def _portable(tx: Transaction, project_id: str, trees: Sequence[documents.Tree | None]) -> list[dict[str, Any] | None]:
    """Return the documents with content digests in place of references to revisions."""
    referred = {one for tree in trees if tree is not None for one in references_in(tree)}
    contents = find_contents_of(tx, project_id, referred)
    return [None if tree is None else portable_document(tree, contents.revisions.get) for tree in trees]


def _tiles_of(tree: documents.Tree | None) -> dict[str, list[str]] | None:
    """Return the digests of the tiles of each array in a document, by JSON Pointer."""
    if tree is None:
        return None
    return {pointer: tile_digests(one) for pointer, one in members_of(tree) if isinstance(one, EncodedArray)}


def _that_fit(digests: list[str | None], sizes: Mapping[str, int]) -> list[str | None]:
    """Cut the list of digests so that the documents have at most `MOST_BYTES_AT_ONCE` bytes in total.

    The first digest is always kept, even if its document alone is larger than this limit.
    """
    size_bytes = 0
    for place, digest in enumerate(digests):
        size_bytes += 0 if digest is None else sizes[digest]
        if place and size_bytes > MOST_BYTES_AT_ONCE:
            return digests[:place]
    return digests
