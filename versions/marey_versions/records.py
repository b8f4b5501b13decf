"""Entries and commits of datasets, and digests of content that do not depend on the ids of a server.

Documents refer to other items by id and revision, which differ between servers. Therefore, each reference in a document
is first replaced by the content digest of the revision that it refers to. Then the content digest of the document is
computed. So two servers with the same content have the same digests, and the same trees.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import orjson

from marey_schemas.documents.blob_references import is_array_reference
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_schemas.names import is_digest
from marey_versions.tree.chunks import DamagedChunk, Value

COMMIT_SCHEMA = "marey/commit@1"

_SEPARATOR = "\t"
"""Character between path and kind in a key. It sorts before every character that a path can contain."""


_KINDS = frozenset(kind.value for kind in Kind)


class RevisionKey(NamedTuple):
    """Reference in a document to a revision of an item."""

    item: str
    revision: int


class DatasetEntry(NamedTuple):
    """Entry in a version of a dataset: its path and kind, the content digests of its parts, and its tags."""

    path: str
    kind: str
    parts: Mapping[str, str]
    """Content digest of each part."""
    tags: tuple[str, ...]

    @property
    def key(self) -> str:
        """The key of the entry in the tree."""
        return key_of(self.path, self.kind)

    @property
    def value(self) -> Value:
        """The value of the entry in the tree."""
        return {"parts": dict(self.parts), "tags": sorted(self.tags)}

    @property
    def content(self) -> str:
        """The content digest of the entry's revision, which does not depend on path and tags."""
        return revision_content(self.kind, self.parts)


def key_of(path: str, kind: str) -> str:
    """Return the key of an entry. Keys sort by path, then by kind."""
    return f"{path}{_SEPARATOR}{kind}"


def entry_of(key: str, value: Value) -> DatasetEntry:
    """Return the entry that a key and its value in the tree describe.

    Raises `DamagedChunk` if the kind is unknown, or if the value is not that of an entry.
    """
    path, kind = path_and_kind(key)
    parts, tags = value.get("parts"), value.get("tags")
    if kind not in _KINDS or type(parts) is not dict or type(tags) is not list:
        raise DamagedChunk(f"the entry {key!r} has an unknown kind, or lacks parts or tags")
    for one in (*parts.values(), *tags):
        if type(one) is not str:
            raise DamagedChunk(f"a part or tag of the entry {key!r} is not a text")
    return DatasetEntry(path, kind, parts, tuple(tags))


def path_and_kind(key: str) -> tuple[str, str]:
    """Return the path and the kind of the entry with a key."""
    path, _, kind = key.partition(_SEPARATOR)
    return path, kind


def revision_content(kind: str, parts: Mapping[str, str]) -> str:
    """Return the content digest of a revision from its kind and the content digests of its parts."""
    # orjson writes objects of texts like `_canonical`, but faster.
    return digest_of(orjson.dumps({"kind": kind, "parts": dict(parts)}, option=orjson.OPT_SORT_KEYS))


def references_in(body: Any) -> Iterator[RevisionKey]:
    """Return the revisions that a stored document refers to: its objects with the members `item` and `revision`."""
    for found in _objects(body):
        if (reference := _reference(found)) is not None:
            yield reference


def document_content(body: Any, content_of: Callable[[RevisionKey], str | None]) -> str:
    """Return the digest of a stored document in which content digests replace references to revisions.

    So the digest is equal on all servers. `content_of` returns the content digest of a revision. If it returns None,
    the reference to this revision is not replaced.
    """
    return digest_of(_canonical(portable_document(body, content_of)))


def portable_document(value: Any, content_of: Callable[[RevisionKey], str | None]) -> Any:
    """Return a document with each reference to a revision replaced by `{"content": digest}`, as other servers need it.

    If `content_of` returns None for a revision, the reference remains unchanged.
    """
    if isinstance(value, dict):
        reference = _reference(value)
        content = content_of(reference) if reference is not None else None
        if content is not None:
            rest = {key: member for key, member in value.items() if key not in ("item", "revision")}
            return {**portable_document(rest, content_of), "content": content}
        return {key: portable_document(member, content_of) for key, member in value.items()}
    return [portable_document(member, content_of) for member in value] if isinstance(value, list) else value


def local_document(value: Any, revision_of: Callable[[str], RevisionKey | None]) -> Any:
    """Return a portable document with each `{"content": digest}` replaced by a reference to a revision on this server.

    If `revision_of` returns None for a digest, the reference remains unchanged. Arrays in the document may be
    references, numpy arrays or `EncodedArray`.
    """
    if isinstance(value, dict):
        content = _content_of(value)
        found = None if content is None else revision_of(content)
        if found is not None:
            rest = {key: member for key, member in value.items() if key != "content"}
            return {**local_document(rest, revision_of), "item": found.item, "revision": found.revision}
        return {key: local_document(member, revision_of) for key, member in value.items()}
    return [local_document(member, revision_of) for member in value] if isinstance(value, list) else value


def contents_in(portable: Any) -> Iterator[str]:
    """Return the content digests of the revisions that a portable document refers to.

    Array references, and objects with a member `blob` (records of imported files), also have a member `content`. They
    do not refer to revisions and are skipped.
    """
    for found in _objects(portable):
        if (content := _content_of(found)) is not None:
            yield content


def _content_of(found: Mapping[str, Any]) -> str | None:
    """Return the content digest of the revision that an object in a portable document refers to.

    Returns None if the object is not a reference to a revision.
    """
    content = found.get("content")
    if not isinstance(content, str) or "blob" in found or is_array_reference(found):
        return None
    return content if is_digest(content) else None


def _objects(value: Any) -> Iterator[Mapping[str, Any]]:
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            yield one
        members: Iterable[Any] = one.values() if isinstance(one, dict) else one
        waiting.extend(member for member in members if isinstance(member, (dict, list)))


def _reference(found: Mapping[str, Any]) -> RevisionKey | None:
    item, revision = found.get("item"), found.get("revision")
    if isinstance(item, str) and isinstance(revision, int) and not isinstance(revision, bool):
        return RevisionKey(item, revision)
    return None


def _canonical(body: Any) -> bytes:
    """Return the canonical JSON of a tree whose numbers are already in canonical form, as in stored documents."""
    return json.dumps(body, sort_keys=True, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()


# -- commits ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CommitRecord:
    """One version of a dataset, with the versions that it was made from."""

    tree: str
    """Digest of the root of the tree of entries."""
    parents: tuple[str, ...]
    """Digests of the commits before this one: none for the first commit, two for a merge."""
    author: str
    """Name of the user on the server where the commit was made."""
    message: str
    at: str
    """Time of the commit in UTC, such as `2026-11-23T10:00:00.000000Z`."""

    @classmethod
    def of(cls, document: Any) -> CommitRecord:
        """Return the commit that a document describes. Raises `ValueError` if it is not the document of a commit."""
        try:
            record = cls(*(document[name] for name in ("tree", "parents", "author", "message", "at")))
            record = replace(record, parents=tuple(record.parents))
        except (KeyError, TypeError) as error:
            raise ValueError("the document is not the record of a commit") from error
        texts = (record.tree, *record.parents, record.author, record.message, record.at)
        if not all(isinstance(one, str) for one in texts) or record.document != document:
            raise ValueError("the document is not the record of a commit")
        return record

    @property
    def document(self) -> dict[str, Any]:
        """The commit as a document."""
        return {
            "schema": COMMIT_SCHEMA,
            "tree": self.tree,
            "parents": list(self.parents),
            "author": self.author,
            "message": self.message,
            "at": self.at,
        }

    @property
    def digest(self) -> str:
        """The digest of the commit, by which every server names it."""
        return digest_of(canonical_json(self.document))
