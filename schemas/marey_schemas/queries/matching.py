"""Evaluation of queries on facts in memory, with the same meaning as the SQL of lists.

Entries of old versions are selected in this way, because the database stores the facts of the newest revisions only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from operator import ge, gt, le, lt
from string import ascii_lowercase, ascii_uppercase
from typing import Any

from marey_schemas.queries.fields import FACET_PREFIX, FIELDS
from marey_schemas.queries.grammar import Condition, Likeness, Negation, Query

_TO_LOWER = str.maketrans(ascii_uppercase, ascii_lowercase)
_ORDERS: dict[str, Callable[[Any, Any], bool]] = {"<": lt, "<=": le, ">": gt, ">=": ge}


@dataclass(frozen=True, slots=True)
class QueriedFacts:
    """Facts of a revision of an item that queries compare.

    If a fact is missing, no condition on it is met.
    """

    name: str
    folder: str
    tags: Collection[str]
    revision: int | None = None
    created_at: datetime | None = None
    updated_at: datetime | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    frames: int = 0
    skeleton: str | None = None
    """Id of the skeleton."""
    skeleton_name: str | None = None
    """Name of the skeleton; None if there is no skeleton, or if the skeleton is deleted."""
    facets: Mapping[str, float] = field(default_factory=dict)


def matches(query: Query, facts: QueriedFacts) -> bool:
    """Return whether a query selects a revision with these facts. Raises `ValueError` for a query with `like(...)`."""
    if isinstance(query, Condition):
        if query.field.startswith(FACET_PREFIX):
            return _number(facts.facets.get(query.field.removeprefix(FACET_PREFIX)), query)
        return _COMPARISONS[query.field](facts, query)
    if isinstance(query, Likeness):
        raise ValueError("a condition like(...) cannot be evaluated on facts, because it needs an index of motions")
    if isinstance(query, Negation):
        return not matches(query.query, facts)
    join = all if query.word == "and" else any
    return join(matches(part, facts) for part in query.queries)


def _lower(text: object) -> str:
    return str(text).translate(_TO_LOWER)


def _text(value: object, condition: Condition) -> bool:
    if value is None:
        return False
    if condition.operator == "~":
        return any(_lower(part) in _lower(value) for part in condition.values)
    return condition.operator == "has" or value in condition.values


def _name(value: str | None, condition: Condition) -> bool:
    """Compare a name; the operator `~` ignores the case of all letters."""
    if condition.operator == "~" and value is not None:
        return any(str(part).casefold() in value.casefold() for part in condition.values)
    return _text(value, condition)


def _number(value: object, condition: Condition) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    if condition.operator in _ORDERS:
        return _ORDERS[condition.operator](value, condition.values[0])
    return condition.operator == "has" or value in condition.values


def _day(value: object, condition: Condition) -> bool:
    """Compare a stored day with the days of the condition; a time in the condition is treated as its day."""
    if value is None or condition.operator == "has":
        return value is not None
    days = [str(one)[: len("2026-11-23")] for one in condition.values]
    if condition.operator in _ORDERS:
        return _ORDERS[condition.operator](str(value), days[0])
    return value in days


def _time(value: datetime | None, condition: Condition) -> bool:
    """Compare a time; a day in the condition is compared as a whole, from midnight to midnight UTC."""
    if value is None or condition.operator == "has":
        return value is not None
    return any(_in_order(value, condition.operator, *_span(one)) for one in condition.values)


def _in_order(value: datetime, operator: str, first: datetime, end: datetime) -> bool:
    return {
        "=": first <= value < end, "<": value < first, "<=": value < end, ">": value >= end, ">=": value >= first,
    }[operator]  # fmt: skip


def _span(one: object) -> tuple[datetime, datetime]:
    """Return the first moment of a day or of a time, and the first moment after it."""
    if isinstance(one, datetime):
        return one, one + timedelta(microseconds=1)
    assert isinstance(one, date)
    first = datetime(one.year, one.month, one.day, tzinfo=UTC)
    return first, first + timedelta(days=1)


def _folder(facts: QueriedFacts, condition: Condition) -> bool:
    """Compare the folder; `=` is true for folders below the given one, too."""
    if condition.operator == "has":
        return facts.folder != ""
    if condition.operator == "~":
        return _text(facts.folder, condition)
    above = [str(path).strip("/") for path in condition.values]
    return any(not path or f"{facts.folder}/".startswith(f"{path}/") for path in above)


def _warning(facts: QueriedFacts, condition: Condition) -> bool:
    codes = facts.summary.get("warnings")
    codes = codes if isinstance(codes, list) else []
    return any(_text(code, condition) for code in codes)


def _skeleton(facts: QueriedFacts, condition: Condition) -> bool:
    if condition.operator == "has":
        return facts.skeleton is not None
    return _name(facts.skeleton_name, condition) or (condition.operator == "=" and facts.skeleton in condition.values)


def _summary_text(name: str) -> Callable[[QueriedFacts, Condition], bool]:
    return lambda facts, condition: _text(facts.summary.get(name), condition)


def _summary_number(name: str) -> Callable[[QueriedFacts, Condition], bool]:
    return lambda facts, condition: _number(facts.summary.get(name), condition)


def _summary_day(name: str) -> Callable[[QueriedFacts, Condition], bool]:
    return lambda facts, condition: _day(facts.summary.get(name), condition)


_COMPARISONS: dict[str, Callable[[QueriedFacts, Condition], bool]] = {
    "name": lambda facts, condition: _name(facts.name, condition),
    "path": lambda facts, condition: _text(f"{facts.folder}/{facts.name}".lstrip("/"), condition),
    "folder": _folder,
    "tag": lambda facts, condition: any(_text(tag, condition) for tag in facts.tags),
    "revision": lambda facts, condition: _number(facts.revision, condition),
    "created": lambda facts, condition: _time(facts.created_at, condition),
    "updated": lambda facts, condition: _time(facts.updated_at, condition),
    "frames": lambda facts, condition: _number(facts.frames or None, condition),
    "duration": _summary_number("duration_s"),
    "rate": _summary_number("frame_rate_hz"),
    "joints": _summary_number("joints"),
    "skeleton": _skeleton,
    "warning": _warning,
    **{name: _summary_text(name) for name in ("subject", "action", "take", "select", "licence", "capture_system")},
    **{name: _summary_day(name) for name in ("shoot_day", "consent_until")},
}
assert set(_COMPARISONS) == set(FIELDS), "every field of queries needs a comparison"
