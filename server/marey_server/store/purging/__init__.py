"""Purges: deleted items are erased for good, so that garbage collection can free the bytes of their content.

Of a purged item, one row without content remains, and one for each of its revisions, because lineage and jobs refer to
these rows. An item that is still needed is not purged; the module `holders` finds the objects that need it.
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
