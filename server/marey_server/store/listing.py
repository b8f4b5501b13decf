"""Pages of lists: sort keys, and signed cursors that stay valid while rows are inserted."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, UnaryExpression, and_, or_, select, union_all

from marey_schemas.encoding.canonical import canonical_json
from marey_server.errors import BadRequestProblem
from marey_server.store.credentials.server_key import read_server_key
from marey_server.store.transaction import Transaction

_MAC_BYTES = 16
DEFAULT_LIMIT = 50
MAX_LIMIT = 1000


@dataclass(frozen=True, slots=True)
class Order:
    """Order of a list by several columns; the last column is unique, so that the order is complete."""

    text: str
    columns: tuple[tuple[ColumnElement[Any], bool], ...]
    """Columns with their directions; True means descending."""

    def clauses(self) -> list[UnaryExpression[Any]]:
        """Return the terms of the clause ORDER BY."""
        return [column.desc() if falls else column.asc() for column, falls in self.columns]

    def after(self, values: Sequence[Any]) -> ColumnElement[bool]:
        """Return the SQL condition for the rows that follow the row with these values in the order.

        The first term of the condition restricts the first column to a range, so that an index can be used.
        """
        (first, falls), *rest = self.columns
        beyond: ColumnElement[bool] = first < values[0] if falls else first > values[0]
        if not rest:
            return beyond
        bound = first <= values[0] if falls else first >= values[0]
        return and_(bound, or_(beyond, Order("", tuple(rest)).after(values[1:])))


def parse_order(text: str, keys: Mapping[str, ColumnElement[Any]], unique: str = "id") -> Order:
    """Parse the parameter `sort` of a list, such as `-created_at,name`; a minus means descending order.

    `keys` maps the allowed keys to columns. The column of the key `unique` is added at the end, so that the order is
    complete. Raises `BadRequestProblem` for an unknown or repeated key.
    """
    names = [part.strip() for part in text.split(",") if part.strip()]
    bare = [name.removeprefix("-") for name in names]
    if unknown := [name for name in bare if name not in keys]:
        raise BadRequestProblem(
            f"This list cannot be sorted by {unknown[0]!r}; it can be sorted by {', '.join(keys)}.", code="bad-sort"
        )
    if len(set(bare)) != len(bare):
        twice = next(name for name in bare if bare.count(name) > 1)
        raise BadRequestProblem(f"The parameter `sort` contains {twice!r} twice; remove one.", code="bad-sort")
    if unique in bare:
        names = names[: bare.index(unique) + 1]
    else:
        names.append(f"-{unique}" if names and names[-1].startswith("-") else unique)
    return Order(",".join(names), tuple((keys[name.removeprefix("-")], name.startswith("-")) for name in names))


def make_cursor(tx: Transaction, order: Order, identity: Any, values: Sequence[Any]) -> str:
    """Return the cursor (an opaque, signed text) for the page after the row with these values.

    `identity` is JSON that distinguishes the list from all other lists.
    """
    payload = json.dumps([order.text, _fingerprint(identity), list(values)], separators=(",", ":")).encode()
    return base64.urlsafe_b64encode(_mac(tx, payload) + payload).decode().rstrip("=")


def read_cursor(tx: Transaction, cursor: str, order: Order, identity: Any) -> list[Any]:
    """Return the values that a cursor contains: those of the last row of the previous page.

    Raises `BadRequestProblem` if no server of this database signed the cursor, or if the cursor is from another list.
    """
    try:
        data = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
    except ValueError as error:
        raise _bad_cursor() from error
    mac, payload = data[:_MAC_BYTES], data[_MAC_BYTES:]
    if not hmac.compare_digest(mac, _mac(tx, payload)):
        raise _bad_cursor()
    text, fingerprint, values = json.loads(payload)
    if text != order.text or fingerprint != _fingerprint(identity):
        raise BadRequestProblem(
            "The cursor belongs to a list with other filters or another order; start again without a cursor.",
            code="bad-cursor",
        )
    return list(values)


def _bad_cursor() -> BadRequestProblem:
    return BadRequestProblem(
        "The cursor does not come from this server; start again without a cursor.", code="bad-cursor"
    )


def _fingerprint(identity: Any) -> str:
    return hashlib.sha256(canonical_json(identity)).hexdigest()[:16]


def _mac(tx: Transaction, payload: bytes) -> bytes:
    return hmac.digest(read_server_key(tx), payload, "sha256")[:_MAC_BYTES]


def read_page(
    tx: Transaction,
    statement: Select[*tuple[Any, ...]],
    order: Order,
    identity: Any,
    cursor: str | None,
    limit: int,
    parts: Sequence[Select[*tuple[Any, ...]]] = (),
) -> tuple[Sequence[Row[Any]], str | None]:
    """Return at most `limit` rows of `statement` after the cursor, and the cursor of the next page.

    `identity` is JSON that distinguishes this list from all other lists: its subject and filters. `parts` are queries
    for values of the last column of the order. If there are `parts`, the list contains only the rows of `statement`
    that at least one of them selects. Only the first rows of each part are read, so an index should contain the rows of
    the part in the order of the list. The second result is None on the last page.

    Raises `BadRequestProblem` if `limit` is out of range, or the cursor is not valid for this list.
    """
    if not 1 <= limit <= MAX_LIMIT:
        raise BadRequestProblem(f"The parameter `limit` must be between 1 and {MAX_LIMIT}.", code="bad-limit")
    after = () if cursor is None else (order.after(read_cursor(tx, cursor, order, identity)),)
    if parts:
        firsts = (part.where(*after).order_by(*order.clauses()).limit(limit + 1).subquery() for part in parts)
        statement = statement.where(order.columns[-1][0].in_(union_all(*map(select, firsts))))
    else:
        statement = statement.where(*after)
    rows = tx.execute(statement.order_by(*order.clauses()).limit(limit + 1)).all()
    if len(rows) <= limit:
        return rows, None
    rows = rows[:limit]
    last = rows[-1]._mapping
    return rows, make_cursor(tx, order, identity, [last[column] for column, _ in order.columns])
