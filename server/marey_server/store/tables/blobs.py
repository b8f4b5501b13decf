"""Tables of stored bytes, of the users and attempts that may refer to them, and of unfinished uploads."""

from sqlalchemy import BigInteger, Boolean, Column, ForeignKey, Index, Integer, LargeBinary, String, Table, false, text

from marey_server.store.tables.columns import DIGEST, ID, Document, Micros, metadata

_OF_UPLOAD = text("upload_id IS NOT NULL")

blob = Table(
    "blob",
    metadata,
    Column("digest", DIGEST, primary_key=True),
    Column("size_bytes", BigInteger, nullable=False),
    Column("created_us", Micros, nullable=False, index=True),
    Column("upload_id", ID),  # of the upload whose pieces are the bytes; null: they are in the backing
    Column("object_id", String(40)),  # of the object in object storage that has the bytes; null: they are elsewhere
    Index("ix_blob_upload", "upload_id", sqlite_where=_OF_UPLOAD, postgresql_where=_OF_UPLOAD),
)

blob_chunk = Table(
    "blob_chunk",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)

blob_holder = Table(  # users who have shown to possess the bytes, and so may refer to them by name
    "blob_holder",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), primary_key=True),
    Column("project_id", ID, primary_key=True, default=""),  # empty: for every project of the user
    Column("created_us", Micros, nullable=False),
)

attempt_blob = Table(  # the same for attempts, which possess nothing of their authors
    "attempt_blob",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("job_id", ID, primary_key=True),
    Column("fence", Integer, primary_key=True),
    Column("created_us", Micros, nullable=False),
    Index("ix_attempt_blob_attempt", "job_id", "fence"),
)

upload = Table(
    "upload",
    metadata,
    Column("id", ID, primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), nullable=False, index=True),  # of an attempt: the author of its job
    Column("job_id", ID),  # the attempt that sends
    Column("fence", Integer),
    Column("project_ids", Document),  # the projects for which a bound token sends
    Column("length", BigInteger, nullable=False),
    Column("offset", BigInteger, nullable=False, default=0),
    Column("digest", DIGEST),  # expected, checked at the end
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False, index=True),
    Column("finished_digest", DIGEST),
    Column("actual_digest", DIGEST),  # of all bytes, if it is not the expected one
    Column("dropped", Boolean, nullable=False, default=False, server_default=false()),  # its pieces can be deleted
)

upload_chunk = Table(
    "upload_chunk",
    metadata,
    Column("upload_id", ID, ForeignKey("upload.id"), primary_key=True),
    Column("offset", BigInteger, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)
