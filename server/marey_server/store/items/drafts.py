"""Drafts of revisions, and the revisions published from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from marey_schemas.kinds import Kind
from marey_server.store.documents import PreparedDocument


@dataclass(frozen=True, slots=True)
class StoredDocument:
    """A document that is stored already. Only for digests that the server itself gave out: nobody checks possession."""

    digest: str


PartContent = PreparedDocument | StoredDocument | dict[str, Any]


@dataclass(frozen=True, slots=True)
class Draft:
    """An item or revision to be.

    `reuse`: `new` makes an item and refuses a name that is taken; `by_name` adds a revision to the item of that name,
    if there is one; `by_content` takes any item of the project whose required parts are equal, and otherwise makes one.
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


@dataclass(frozen=True, slots=True)
class Published:
    """Revision published from a draft. `created`: this revision was made now, by this draft."""

    name: str
    item: str
    kind: Kind
    revision: int
    created: bool
