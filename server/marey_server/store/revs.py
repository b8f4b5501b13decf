"""Changes of rows that carry a `rev`: the precondition is part of the statement, and the row count decides."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Column, ColumnElement, Row, Table, select, true, update

from marey_server.errors import ApiProblem, PreconditionFailedProblem
from marey_server.store.transaction import Transaction

ExpectedRev = int | frozenset[int] | None
"""The `rev` that a writer believes in, or several of which any will do; None for any at all."""


def at_rev(column: Column[int], expected: ExpectedRev) -> ColumnElement[bool]:
    """Condition for the statement that writes: the row is at an expected `rev`."""
    if expected is None:
        return true()
    return column == expected if isinstance(expected, int) else column.in_(sorted(expected))


def is_expected(rev: int, expected: ExpectedRev) -> bool:
    """Return the same of a `rev` that was read."""
    return expected is None or (rev == expected if isinstance(expected, int) else rev in expected)


def change_row(
    tx: Transaction,
    table: Table,
    which: tuple[ColumnElement[bool], ...],
    values: dict[str, Any],
    *,
    expected_rev: ExpectedRev,
    absent: ApiProblem,
) -> Row[Any]:
    """Change the one row that meets `which`, if its `rev` is an expected one.

    Raises `absent` where there is no such row, `PreconditionFailedProblem` with the current `rev` where it has changed.
    """
    expected = at_rev(table.c.rev, expected_rev)
    statement = update(table).where(*which, expected).values(**values, rev=table.c.rev + 1).returning(*table.c)
    row = tx.execute(statement).first()
    if row is not None:
        return row
    current = tx.execute(select(table.c.rev).where(*which)).scalar()
    raise absent if current is None else moved_on(current)


def moved_on(current_rev: int) -> PreconditionFailedProblem:
    """Somebody else changed it first; `context.rev` is the present state."""
    return PreconditionFailedProblem(
        f"This has changed since you read it (it is at rev {current_rev} now). Read it again, then repeat the change.",
        context={"rev": current_rev},
    )
