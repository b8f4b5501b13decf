"""Metadata of all tables, and the types of their columns."""

from sqlalchemy import JSON, BigInteger, Index, Integer, MetaData, String, text
from sqlalchemy.dialects.postgresql import JSONB

NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
metadata = MetaData(naming_convention=NAMING)

Document = JSON().with_variant(JSONB(), "postgresql")
Micros = BigInteger
Sequence64 = BigInteger().with_variant(Integer(), "sqlite")  # SQLite numbers rows by itself only for INTEGER keys
ID = String(40)
Name = String(255).with_variant(String(255, collation="C"), "postgresql")  # by code point, as SQLite sorts
Path = String(1024).with_variant(String(1024, collation="C"), "postgresql")
DIGEST = String(71)


def unique_alive(table: str, *columns: str) -> Index:
    """Return a unique index over rows that are not deleted, so that a deleted name can be used again."""
    condition = text("deleted_us IS NULL")
    return Index(f"uq_{table}_alive", *columns, unique=True, sqlite_where=condition, postgresql_where=condition)
