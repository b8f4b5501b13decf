"""Content of versions for archives and other servers: documents contain no ids of this server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import select

from marey_schemas.access import Role
from marey_schemas.datasets.contents import (
    ContentsRequest,
    ExportCheck,
    ExportPermission,
    RequestedDocument,
)
from marey_schemas.documents.blob_references import members_of, references_of
from marey_schemas.encoding.arrays import MAX_ARRAY_BYTES, EncodedArray
from marey_schemas.encoding.partial_arrays import tile_digests
from marey_server.prepared_documents import Tree
from marey_server.store import documents, projects
from marey_server.store.datasets.contents import Contents, find_contents_of
from marey_server.store.datasets.history import revisions_with
from marey_server.store.datasets.naming import find_dataset
from marey_server.store.datasets.partial_contents import DocumentComparison
from marey_server.store.items.consents import find_ended_with, record_override, require_consent
from marey_server.store.items.facets import facets_of_contents
from marey_server.store.items.reading import MOST_BYTES_AT_ONCE
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import document, item
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import RevisionKey, portable_document, references_in

MOST_BYTES_COMPARED = MAX_ARRAY_BYTES
"""Greatest total size in bytes of the arrays of one answer that are compared with arrays that the reader has.

The other arrays are sent whole.
"""


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
class _LoadedDocument:
    """Document that was loaded for an answer, and the document `base`, whose arrays the reader has already."""

    tree: Tree | None
    """Loaded document; None if the project does not have the document."""
    base: Tree | None = None
    base_content: str = ""
    """Content digest of the revision with the document `base`."""
    arrays: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """References to the arrays of `tree`, by JSON Pointer, if there is a `base`."""


@dataclass(frozen=True)
class LoadedContents:
    """Answer to a request for contents, before its arrays are compared with those that the reader has."""

    members: Mapping[str, Any]
    documents: Sequence[_LoadedDocument]
    tiled: Sequence[_LoadedDocument]
    """Documents for whose arrays the answer lists the digests of the tiles."""


def contents_document(loaded: LoadedContents) -> dict[str, Any]:
    """Return the answer to a request for contents; arrays similar to those that the reader has become differences.

    Call this function outside of transactions, because the comparison of large arrays takes long.
    """
    comparison = DocumentComparison(MOST_BYTES_COMPARED)
    found = [
        one.tree if one.base is None else comparison.compared(one.tree, one.base, one.arrays, one.base_content)
        for one in loaded.documents
    ]
    return {**loaded.members, "documents": found, "tiles": [_tiles_of(one.tree) for one in loaded.tiled]}


def load_contents(tx: Transaction, project: str, request: ContentsRequest) -> LoadedContents:
    """Load the revisions of a project that have the requested content digests, their facets, and their documents.

    The arrays of the documents stay encoded. A revision or document that the project does not have is None. If the
    documents together are too large, the list of documents ends early, but always contains the first document. The list
    of documents whose tiles are requested ends early under the same condition.
    """
    project_row = projects.require(tx, project)
    wanted = {*request.revisions, *(one.content for one in (*request.documents, *request.tiles))}
    wanted |= {one.base for one in request.documents if one.base is not None}
    held = {one: RevisionKey(*key) for one, key in revisions_with(tx, project_row.id, wanted).items()}
    contents = find_contents_of(tx, project_row.id, held.values())
    members = {
        "revisions": _described(tx, held, contents, request),
        "facets": _facets(tx, project_row.id, request),
    }
    loaded = _portable(tx, project_row.id, _loaded(tx, held, request.documents))
    places = [RequestedDocument(content=one.content, part=one.part) for one in request.tiles]
    return LoadedContents(members, loaded, tiled=_loaded(tx, held, places))


def _facets(tx: Transaction, project_id: str, request: ContentsRequest) -> list[dict[str, float]]:
    """Return the facets of each requested revision, by name, in the order of the request."""
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
    tx: Transaction, held: Mapping[str, RevisionKey], places: Sequence[RequestedDocument]
) -> list[_LoadedDocument]:
    """Load the documents at `places`, each with its base, as many as fit into an answer."""
    named = {content for one in places for content in (one.content, one.base)}
    keys = {content: held[content] for content in named if content is not None and content in held}
    parts = read_part_digests(tx, set(keys.values()))
    of_content = {content: parts[key] for content, key in keys.items()}
    digests = [
        (of_content.get(one.content, {}).get(one.part), of_content.get(one.base or "", {}).get(one.part))
        for one in places
    ]
    present = sorted({digest for pair in digests for digest in pair if digest is not None})
    statement = select(document.c.digest, document.c.size_bytes)
    sizes = {
        row.digest: row.size_bytes
        for some in in_lists(present)
        for row in tx.execute(statement.where(document.c.digest.in_(some)))
    }
    chosen = _that_fit(digests, sizes)
    trees = documents.load_documents(tx, {digest for pair in chosen for digest in pair if digest is not None})
    bodies = documents.load_bodies(tx, {digest for digest, base in chosen if digest is not None and base is not None})
    return [
        _LoadedDocument(
            None if digest is None else trees[digest],
            None if base is None or digest is None else trees[base],
            place.base or "",
            references_of("", bodies[digest])[0] if digest in bodies else {},
        )
        for place, (digest, base) in zip(places, chosen, strict=False)
    ]


def _portable(tx: Transaction, project_id: str, loaded: Sequence[_LoadedDocument]) -> list[_LoadedDocument]:
    """Return the documents with content digests in place of references to revisions."""
    referred = {reference for one in loaded if one.tree is not None for reference in references_in(one.tree)}
    contents = find_contents_of(tx, project_id, referred)
    return [
        one if one.tree is None else replace(one, tree=portable_document(one.tree, contents.revisions.get))
        for one in loaded
    ]


def _tiles_of(tree: Tree | None) -> dict[str, list[str]] | None:
    """Return, by JSON Pointer, the digests of the tiles of each array in a document; None for a missing document."""
    if tree is None:
        return None
    return {pointer: tile_digests(one) for pointer, one in members_of(tree) if isinstance(one, EncodedArray)}


def _that_fit(
    digests: list[tuple[str | None, str | None]], sizes: Mapping[str, int]
) -> list[tuple[str | None, str | None]]:
    """Cut a list of documents and their bases, so that they have at most `MOST_BYTES_AT_ONCE` bytes in total.

    The first document and its base are always kept, even if they alone are larger than this limit.
    """
    size_bytes = 0
    for place, pair in enumerate(digests):
        size_bytes += sum(sizes[digest] for digest in pair if digest is not None)
        if place and size_bytes > MOST_BYTES_AT_ONCE:
            return digests[:place]
    return digests
