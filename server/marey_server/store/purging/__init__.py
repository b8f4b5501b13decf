"""Purges: deleted items are erased for good, so that garbage collection can free the bytes of their content.

Of a purged item, an empty row remains, with a row for each of its revisions: lineage and jobs refer to them. An item
that something still needs is not purged; `holders` says what holds it.
"""

from marey_server.store.purging.candidates import PreparedPurge, prepare_purge
from marey_server.store.purging.citations import delete_uncited_ref, find_citations
from marey_server.store.purging.recording import preview_purge, record_purge
from marey_server.store.purging.whole_datasets import (
    prepare_dataset_purge,
    preview_dataset_purge,
    record_dataset_purge,
)

__all__ = [
    "PreparedPurge",
    "delete_uncited_ref",
    "find_citations",
    "prepare_dataset_purge",
    "prepare_purge",
    "preview_dataset_purge",
    "preview_purge",
    "record_dataset_purge",
    "record_purge",
]
