"""Changes of rows on the condition that nobody else has changed them since they were read.

The column `rev` of a row is a number that grows with each change. A change names the `rev` that it expects. This
condition is part of the UPDATE statement; if no row is returned, the row has another `rev`, or does not exist.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Column, ColumnElement, Row, Table, select, true, update

from marey_server.errors import ApiProblem, PreconditionFailedProblem
from marey_server.store.transaction import Transaction

ExpectedRev = int | frozenset[int] | None
"""The `rev` that a writer expects in the row, or several acceptable values; None accepts any `rev`."""


def at_rev(column: Column[int], expected: ExpectedRev) -> ColumnElement[bool]:
    """Return the SQL condition that a row has an expected `rev`, for the UPDATE that changes the row."""
    if expected is None:
        return true()
    return column == expected if isinstance(expected, int) else column.in_(sorted(expected))


def is_expected(rev: int, expected: ExpectedRev) -> bool:
    """Return whether `rev` is the expected value or one of several; always true if None is expected."""
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
    """Change the one row that meets `which`, if its `rev` is an expected one, and return the changed row.

    Raises `absent` if there is no such row, and `PreconditionFailedProblem` with the current `rev` if the row has
    changed.
    """
    expected = at_rev(table.c.rev, expected_rev)
    statement = update(table).where(*which, expected).values(**values, rev=table.c.rev + 1).returning(*table.c)
    row = tx.execute(statement).first()
    if row is not None:
        return row
    current = tx.execute(select(table.c.rev).where(*which)).scalar()
    raise absent if current is None else moved_on(current)


def moved_on(current_rev: int) -> PreconditionFailedProblem:
    """Return the error for a resource that was changed by another request; `context.rev` is its current `rev`."""
    return PreconditionFailedProblem(
        f"The resource has changed since you read it; its rev is {current_rev} now. Read it again, then repeat the "
        "change.",
        context={"rev": current_rev},
    )
