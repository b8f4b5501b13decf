"""Datasets: versions of named entries, with branches, tags, commits and differences."""

from marey_server.store.datasets.checkout import check_out
from marey_server.store.datasets.committing import PreparedCommit, prepare_commit, record_commit
from marey_server.store.datasets.history import (
    compare_versions,
    entries_of_kind,
    list_commits,
    list_entries,
    read_commit,
    read_origins,
)
from marey_server.store.datasets.merging import PreparedMerge, prepare_merge, prepare_pick, record_merge
from marey_server.store.datasets.naming import (
    create_dataset,
    create_ref,
    delete_dataset,
    delete_ref,
    list_datasets,
    list_refs,
    move_branch,
    protect_branch,
    read_dataset,
    read_ref,
)
from marey_server.store.datasets.portable import check_export, contents_document, load_contents
from marey_server.store.datasets.receiving import (
    find_local,
    prepare_receipt,
    prepare_revisions,
    record_receipt,
    store_revisions,
)
from marey_server.store.datasets.selecting import select_entries

__all__ = [
    "PreparedCommit",
    "PreparedMerge",
    "check_export",
    "check_out",
    "compare_versions",
    "contents_document",
    "create_dataset",
    "create_ref",
    "delete_dataset",
    "delete_ref",
    "entries_of_kind",
    "find_local",
    "list_commits",
    "list_datasets",
    "list_entries",
    "list_refs",
    "load_contents",
    "move_branch",
    "prepare_commit",
    "prepare_merge",
    "prepare_pick",
    "prepare_receipt",
    "prepare_revisions",
    "protect_branch",
    "read_commit",
    "read_dataset",
    "read_origins",
    "read_ref",
    "record_commit",
    "record_merge",
    "record_receipt",
    "select_entries",
    "store_revisions",
]
