"""Drafts of items and revisions, and the revisions published from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from marey_schemas.kinds import Kind
from marey_server.prepared_documents import PreparedDocument


@dataclass(frozen=True, slots=True)
class StoredDocument:
    """Digest of a stored document.

    The digest must come from the server itself, because the caller's access to the document is not checked.
    """

    digest: str


PartContent = PreparedDocument | StoredDocument | dict[str, Any]


@dataclass(frozen=True, slots=True)
class Draft:
    """Content of an item or revision that is to be published.

    `reuse` says what happens if the draft matches an existing item:

    * `new` creates an item, and fails if another item has the name.
    * `by_name` adds a revision to the item that has the name; without such an item, it creates one.
    * `by_content` uses an item of the project whose required parts are equal; without such an item, it creates one.

    With `same_skeleton`, the draft is not published if the existing item of this name has another skeleton.
    """

    name_in_batch: str
    kind: Kind
    item_name: str
    parts: Mapping[str, PartContent]
    collection: str = ""
    tags: Sequence[str] = ()
    sources: Mapping[str, Sequence[tuple[str, int]]] = field(default_factory=dict)
    reuse: Literal["by_name", "by_content", "new"] = "by_name"
    message: str = ""
    same_skeleton: bool = False
    hidden: bool = False
    """Whether a new item is created as a deleted item, so that no folder shows it before a checkout restores it."""


@dataclass(frozen=True, slots=True)
class Published:
    """Revision published from a draft; `created` is false if an existing revision is used.

    `skeleton_changed` says whether the previous revision of the item has another skeleton.
    """

    name: str
    item: str
    kind: Kind
    revision: int
    created: bool
    skeleton_changed: bool = False
