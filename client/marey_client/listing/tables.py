"""Tables of items for pandas."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from marey_client.extras import import_optional
from marey_schemas.items import Item

TABLES_EXTRA = "notebook"
"""Extra of the package `marey` that installs pandas, pyarrow and xarray."""


class HasItem(Protocol):
    """Object with an item, such as a handle."""

    item: Item


def summary_table(handles: Iterable[HasItem]) -> Any:
    """Return a pandas table with one row for each item: its path and revision, its summary and its facets.

    The index is the id. Raises `MissingPackage` if pandas is not installed.
    """
    pandas = import_optional("pandas", TABLES_EXTRA)
    rows = [_row(one.item) for one in handles]
    if not rows:
        return pandas.DataFrame(columns=["path", "name", "collection", "revision", "tags"])
    return pandas.DataFrame(rows).set_index("id")


def _row(item: Item) -> dict[str, Any]:
    return {
        "id": item.id, "path": item.path, "name": item.name, "collection": item.collection, "revision": item.revision,
        "tags": ", ".join(item.tags), **item.summary, **item.facets, "updated_at": item.updated_at,
    }  # fmt: skip
