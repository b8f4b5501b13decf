"""Metadata of all tables, the types of their columns, and expressions that queries and indexes have in common."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, ColumnElement, Index, Integer, MetaData, String, Text, literal_column, text
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

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


INDEXED_CHARACTERS = 100
"""Number of characters of a text that an index contains at most, because Postgres refuses long index entries."""


class MemberStart(FunctionElement[str]):
    """SQL expression for the first `INDEXED_CHARACTERS` characters of a member of a JSON object.

    It is null if the object has no such member. The name of the member is part of the SQL and not a parameter: a
    database uses an index over an expression only for statements that contain the same expression.
    """

    type = Text()
    inherit_cache = True

    def __init__(self, document: ColumnElement[Any], name: str) -> None:
        assert name.isidentifier()
        super().__init__(document, literal_column(f"'$.{name}'"), literal_column(f"'{name}'"))


@compiles(MemberStart)
def _start(element: MemberStart, compiler: SQLCompiler, **options: Any) -> str:
    document, path, _ = (compiler.process(one, **options) for one in element.clauses)
    return f"substr(json_extract({document}, {path}), 1, {INDEXED_CHARACTERS})"


@compiles(MemberStart, "postgresql")
def _start_on_postgres(element: MemberStart, compiler: SQLCompiler, **options: Any) -> str:
    document, _, name = (compiler.process(one, **options) for one in element.clauses)
    return f"substr({document} ->> {name}, 1, {INDEXED_CHARACTERS})"
