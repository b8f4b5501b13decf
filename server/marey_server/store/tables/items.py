"""Tables of folders, of items and their revisions, and of the documents of revisions."""

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    String,
    Table,
    Text,
    and_,
    text,
)

from marey_server.store.tables.columns import (
    DIGEST,
    ID,
    Document,
    MemberStart,
    Micros,
    Name,
    Path,
    metadata,
    unique_alive,
)

collection = Table(
    "collection",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("path", Path, nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    unique_alive("collection", "project_id", "path"),
)

_PURGED = text("purged_us IS NOT NULL")
_RESTORABLE = text("deleted_us IS NOT NULL AND purged_us IS NULL")

item = Table(
    "item",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("collection_id", ID, ForeignKey("collection.id"), nullable=False, index=True),
    Column("kind", String(16), nullable=False),
    Column("name", Name, nullable=False),
    Column("name_folded", Text, nullable=False),  # for searches that do not see case, in any script
    Column("head", Integer, nullable=False),
    Column("summary", Document, nullable=False),
    Column("frames", Integer, nullable=False, default=0),
    Column("skeleton_id", ID, index=True),
    Column("creator_id", ID),  # the user for whom the item counts; null for the server
    Column("stored_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),  # of all its revisions
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("purged_us", Micros),  # when its content, name and tags were deleted for good; `deleted_us` is set, too
    Column("rev", Integer, nullable=False, default=1),
    unique_alive("item", "collection_id", "kind", "name"),
    Index("ix_item_purged", "project_id", "purged_us", sqlite_where=_PURGED, postgresql_where=_PURGED),
    Index("ix_item_deleted", "project_id", "kind", "id", sqlite_where=_RESTORABLE, postgresql_where=_RESTORABLE),
    Index("ix_item_listing", "project_id", "kind", "id"),
    Index("ix_item_by_name", "project_id", "kind", "name", "id"),
    Index("ix_item_by_creation", "project_id", "kind", "created_us", "id"),
    Index("ix_item_by_update", "project_id", "kind", "updated_us", "id"),
    Index("ix_item_by_frames", "project_id", "kind", "frames", "id"),
)

INDEXED_FACTS = ("subject", "action", "take", "shoot_day", "licence")
"""Names of the members of summaries for which there is an index.

The other members have too few different values for an index to make queries faster.
"""


def _add_index(name: str) -> None:
    """Add an index of items by the member `name` of their summary, a JSON object.

    The index contains the items that have this member and are not deleted. Items with the same value are sorted by
    creation and id, as lists show them.
    """
    start = MemberStart(item.c.summary, name)
    stated = and_(start.is_not(None), item.c.deleted_us.is_(None))
    columns = (item.c.project_id, item.c.kind, start, item.c.created_us, item.c.id)
    Index(f"ix_item_by_{name}", *columns, sqlite_where=stated, postgresql_where=stated)


for _fact in INDEXED_FACTS:
    _add_index(_fact)

item_tag = Table(
    "item_tag",
    metadata,
    Column("item_id", ID, ForeignKey("item.id"), primary_key=True),
    Column("tag", String(64), primary_key=True, index=True),
)

revision = Table(
    "revision",
    metadata,
    Column("item_id", ID, ForeignKey("item.id"), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("author_id", ID, ForeignKey("user.id")),
    Column("message", Text, nullable=False, default=""),
    Column("job_id", ID, index=True),
    Column("created_us", Micros, nullable=False),
    Column("content", DIGEST, index=True),  # digest that every server gives to the same content; null: not needed yet
)

revision_part = Table(
    "revision_part",
    metadata,
    Column("item_id", ID, primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("part", String(32), primary_key=True),
    Column("document_digest", DIGEST, ForeignKey("document.digest"), nullable=False, index=True),
    Column("content", DIGEST),  # as that of the revision; null if the document's own digest is the same everywhere
    ForeignKeyConstraint(["item_id", "number"], ["revision.item_id", "revision.number"]),
)

item_facet = Table(  # numbers that jobs published about revisions of their inputs
    "item_facet",
    metadata,
    Column("item_id", ID, primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("name", String(64), primary_key=True),
    Column("value", Double, nullable=False),
    ForeignKeyConstraint(["item_id", "number"], ["revision.item_id", "revision.number"]),
    Index("ix_item_facet_name_value", "name", "value", "item_id"),
)

document = Table(
    "document",
    metadata,
    Column("digest", DIGEST, primary_key=True),
    Column("schema", String(128), nullable=False),
    Column("body", Document, nullable=False),  # array leaves stand as {"dtype", "shape", "content"}
    Column("size_bytes", BigInteger, nullable=False),
    Column("file_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),  # of the files it names
    Column("created_us", Micros, nullable=False),
)

document_blob = Table(
    "document_blob",
    metadata,
    Column("document_digest", DIGEST, ForeignKey("document.digest"), primary_key=True),
    Column("pointer", String(512), primary_key=True),  # JSON Pointer of the array leaf or of the digest in `body`
    Column("blob_digest", DIGEST, ForeignKey("blob.digest"), nullable=False, index=True),
)

document_item = Table(  # items to which documents refer
    "document_item",
    metadata,
    Column("document_digest", DIGEST, ForeignKey("document.digest"), primary_key=True),
    Column("item_id", ID, primary_key=True, index=True),
)

lineage = Table(
    "lineage",
    metadata,
    Column("item_id", ID, primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("role", String(64), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("input_item_id", ID, nullable=False),
    Column("input_number", Integer, nullable=False),
    Column("job_id", ID, index=True),
    ForeignKeyConstraint(["item_id", "number"], ["revision.item_id", "revision.number"]),
    ForeignKeyConstraint(
        ["input_item_id", "input_number"], ["revision.item_id", "revision.number"], name="fk_lineage_input"
    ),
    Index("ix_lineage_input", "input_item_id", "input_number"),
)
