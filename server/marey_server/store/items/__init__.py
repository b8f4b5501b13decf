"""Items: named things with revisions. This package is the only one that writes them."""

from marey_server.store.items.drafts import Draft, Published, StoredDocument
from marey_server.store.items.listing import ItemFilters, list_items
from marey_server.store.items.publishing import publish
from marey_server.store.items.reading import Part, read_item, read_part

__all__ = [
    "Draft",
    "ItemFilters",
    "Part",
    "Published",
    "StoredDocument",
    "list_items",
    "publish",
    "read_item",
    "read_part",
]
