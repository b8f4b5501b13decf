"""Changes of rows that carry a `rev`: the precondition is part of the statement, and the row count decides."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Row, Table, select, update

from marey_server.errors import MareyError, PreconditionFailed
from marey_server.store.transaction import Transaction


def change_row(
    tx: Transaction,
    table: Table,
    which: tuple[ColumnElement[bool], ...],
    values: dict[str, Any],
    *,
    expected_rev: int | None,
    absent: MareyError,
) -> Row[Any]:
    """Change the one row that meets `which`, if its `rev` is the expected one (None: whatever it is).

    Raises `absent` where there is no such row, `PreconditionFailed` with the current `rev` where it has changed.
    """
    statement = update(table).where(*which).values(**values, rev=table.c.rev + 1).returning(*table.c)
    if expected_rev is not None:
        statement = statement.where(table.c.rev == expected_rev)
    row = tx.execute(statement).first()
    if row is not None:
        return row
    current = tx.execute(select(table.c.rev).where(*which)).scalar()
    raise absent if current is None else moved_on(current)


def moved_on(current_rev: int) -> PreconditionFailed:
    """Somebody else was faster; `context.rev` tells the state now."""
    return PreconditionFailed(
        f"This has changed since you read it (it is at rev {current_rev} now). Read it again, then repeat the change.",
        context={"rev": current_rev},
    )
