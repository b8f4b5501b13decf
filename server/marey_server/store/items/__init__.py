"""Items: named things with revisions. Only this package creates items and revisions."""

from marey_server.store.items.annotating import (
    find_annotated_clip,
    find_annotation,
    put_changed,
)
from marey_server.store.items.changing import (
    change_item,
    create_item,
    delete_item,
    prepare_part,
    prepare_parts,
    put_part,
    restore_content,
    restore_item,
    revert_item,
)
from marey_server.store.items.consents import find_ended_consents, permit_export, require_consent
from marey_server.store.items.drafts import Draft, Published, StoredDocument
from marey_server.store.items.history import (
    list_revisions,
    list_staleness,
    read_lineage,
    read_revision,
    read_staleness,
)
from marey_server.store.items.lineage_graphs import read_lineage_graph
from marey_server.store.items.listing import ItemFilters, Namesakes, explain_query, find_namesakes, list_items
from marey_server.store.items.publishing import publish
from marey_server.store.items.reading import (
    FoundPart,
    Part,
    cut_part,
    find_contents,
    find_part,
    load_part,
    load_parts,
    read_item,
    read_part,
)
from marey_server.store.items.skeleton_merges import merge_skeletons

__all__ = [
    "Draft",
    "FoundPart",
    "ItemFilters",
    "Namesakes",
    "Part",
    "Published",
    "StoredDocument",
    "change_item",
    "create_item",
    "cut_part",
    "delete_item",
    "explain_query",
    "find_annotated_clip",
    "find_annotation",
    "find_contents",
    "find_ended_consents",
    "find_namesakes",
    "find_part",
    "list_items",
    "list_revisions",
    "list_staleness",
    "load_part",
    "load_parts",
    "merge_skeletons",
    "permit_export",
    "prepare_part",
    "prepare_parts",
    "publish",
    "put_changed",
    "put_part",
    "read_item",
    "read_lineage",
    "read_lineage_graph",
    "read_part",
    "read_revision",
    "read_staleness",
    "require_consent",
    "restore_content",
    "restore_item",
    "revert_item",
]
