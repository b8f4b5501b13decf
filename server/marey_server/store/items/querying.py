"""Conversion of queries to SQL: conditions on the rows of a list of items."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from datetime import date, datetime, timedelta
from string import ascii_lowercase, ascii_uppercase
from typing import Any

from sqlalchemy import (
    Boolean,
    ColumnElement,
    Float,
    Text,
    and_,
    case,
    exists,
    false,
    func,
    literal,
    literal_column,
    not_,
    or_,
    select,
    true,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from marey_schemas.queries.fields import FACET_PREFIX, FIELDS
from marey_schemas.queries.grammar import Condition, Likeness, Negation, Query
from marey_server.errors import BadRequestProblem
from marey_server.store import collections
from marey_server.store.database.clock import DAY_US, micros_of
from marey_server.store.tables import collection, item, item_facet, item_tag

Comparison = Callable[[Condition, str], ColumnElement[bool]]
"""Function that converts a condition of a query to SQL, given the id of the project; the SQL is never null."""

_MOST_FRAMES = 2.0**31 - 2
"""Greatest number with which numbers of frames are compared: the column `frames` can hold it, and no item has more."""


def sql_of(query: Query, project_id: str) -> ColumnElement[bool]:
    """Return the SQL condition that is true for the items of a project that a query selects."""
    if isinstance(query, Condition):
        compare = _facet if query.field.startswith(FACET_PREFIX) else COMPARISONS[query.field]
        return compare(query, project_id)
    if isinstance(query, Likeness):
        return is_like(query)
    if isinstance(query, Negation):
        return not_(sql_of(query.query, project_id))
    join = and_ if query.word == "and" else or_
    return join(*(sql_of(part, project_id) for part in query.queries))


def clips_like(condition: Likeness) -> list[str]:
    """Return the ids of the clips that meet a condition `like(...)`, which must have been searched for before.

    Raises `BadRequestProblem` if they were not, because only lists of clips accept such a condition.
    """
    if condition.clips is None:
        raise BadRequestProblem(
            f"query, column {condition.column}: like(...) compares the newest revisions of existing clips, so only "
            "lists of clips accept it; list the clips first, and give their names or paths here",
            code="bad-query",
            context={"column": condition.column},
        )
    return sorted(condition.clips)


def is_like(condition: Likeness) -> ColumnElement[bool]:
    """Return the SQL condition that an item is among the clips of a condition `like(...)`.

    Raises `BadRequestProblem` as `clips_like` does.
    """
    listed = _TextsOf(literal(json.dumps(clips_like(condition)), Text()))
    found: ColumnElement[bool] = item.c.id.op("IN", is_comparison=True, return_type=Boolean())(listed)
    return found


class _TextsOf(FunctionElement[str]):
    """SQL expression for the texts in a JSON list, which is a single parameter of the statement at any length."""

    type = Text()
    inherit_cache = True


@compiles(_TextsOf)
def _texts_of(element: _TextsOf, compiler: SQLCompiler, **options: Any) -> str:
    return f"(SELECT value FROM json_each({compiler.process(element.clauses, **options)}))"  # noqa: S608 (a parameter)


@compiles(_TextsOf, "postgresql")
def _texts_of_on_postgres(element: _TextsOf, compiler: SQLCompiler, **options: Any) -> str:
    return f"(SELECT jsonb_array_elements_text(CAST({compiler.process(element.clauses, **options)} AS jsonb)))"


def _any(made: list[ColumnElement[bool]]) -> ColumnElement[bool]:
    return or_(false(), *made)


def _is_true(condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return an SQL condition with null replaced by false."""
    return func.coalesce(condition, false())


class _LowerAscii(FunctionElement[str]):
    """SQL expression that converts the letters A to Z of a text to lower case.

    Whether it converts other letters depends on the database and its collation.
    """

    type = Text()
    inherit_cache = True


@compiles(_LowerAscii)
def _lower(element: _LowerAscii, compiler: SQLCompiler, **options: Any) -> str:
    return f"lower({compiler.process(element.clauses, **options)})"


@compiles(_LowerAscii, "postgresql")
def _lower_on_postgres(element: _LowerAscii, compiler: SQLCompiler, **options: Any) -> str:
    return f'lower(({compiler.process(element.clauses, **options)}) COLLATE "C")'


class _NumberIn(FunctionElement[float]):
    """SQL expression for a number in the summary of an item, or null if the summary has no number there.

    A plain cast to a number would fail for other values.
    """

    type = Float()
    inherit_cache = True


@compiles(_NumberIn)
def _number(element: _NumberIn, compiler: SQLCompiler, **options: Any) -> str:
    summary, name = (compiler.process(one, **options) for one in element.clauses)
    at = f"{summary}, '$.' || {name}"
    return f"CASE WHEN json_type({at}) IN ('integer', 'real') THEN json_extract({at}) END"


@compiles(_NumberIn, "postgresql")
def _number_on_postgres(element: _NumberIn, compiler: SQLCompiler, **options: Any) -> str:
    summary, name = (compiler.process(one, **options) for one in element.clauses)
    number = f"({summary} ->> {name})"
    return (
        f"CASE WHEN jsonb_typeof({summary} -> {name}) = 'number' AND abs({number}::numeric) < 1e300 "
        f"THEN {number}::float8 END"
    )


_TO_LOWER = str.maketrans(ascii_uppercase, ascii_lowercase)


def _contains(value: ColumnElement[Any], part: object) -> ColumnElement[bool]:
    """Return the SQL condition that a text contains another; the case of the letters A to Z is ignored."""
    return _LowerAscii(value).contains(str(part).translate(_TO_LOWER), autoescape=True)


def _texts(value: ColumnElement[Any], condition: Condition) -> ColumnElement[bool]:
    """Return the SQL for a condition of a query on a text that may be null."""
    if condition.operator == "has":
        return value.is_not(None)
    if condition.operator == "~":
        return _is_true(_any([_contains(value, part) for part in condition.values]))
    return _is_true(value.in_([str(one) for one in condition.values]))


def _numbers(value: ColumnElement[Any], condition: Condition) -> ColumnElement[bool]:
    """Return the SQL for a condition of a query on a number that may be null."""
    if condition.operator == "has":
        return value.is_not(None)
    if condition.operator == "=":
        return _is_true(value.in_(condition.values))
    return _is_true(_ordered(value, condition.operator, condition.values[0]))


def _ordered(value: ColumnElement[Any], operator: str, limit: object) -> ColumnElement[bool]:
    compared: ColumnElement[bool] = value.op(operator, is_comparison=True, return_type=Boolean())(limit)
    return compared


def _text_of(name: str) -> Comparison:
    return lambda condition, _: _texts(item.c.summary[name].as_string(), condition)


def _number_of(name: str) -> Comparison:
    return lambda condition, _: _numbers(_NumberIn(item.c.summary, literal_column(f"'{name}'")), condition)


def stored_text(value: object) -> str:
    """Return the text with which a summary stores a value: a text unchanged, a day in the form `2026-11-23`.

    A time is converted to its day, because summaries store no times.
    """
    return value.isoformat()[: len("2026-11-23")] if isinstance(value, date) else str(value)


def _day_of(name: str) -> Comparison:
    """Return a function that converts conditions on the member `name` of summaries, which is a day, to SQL."""

    def compare(condition: Condition, _: str) -> ColumnElement[bool]:
        stored: ColumnElement[Any] = item.c.summary[name].as_string()
        if condition.operator == "has":
            return stored.is_not(None)
        days = [stored_text(one) for one in condition.values]
        if condition.operator == "=":
            return _is_true(stored.in_(days))
        return _is_true(_ordered(stored, condition.operator, days[0]))

    return compare


def _time_of(column: ColumnElement[Any]) -> Comparison:
    """Return a function that converts conditions on a column with a time in microseconds to SQL.

    If a condition gives a day, the day is compared as a whole, from midnight to midnight UTC.
    """

    def compare(condition: Condition, _: str) -> ColumnElement[bool]:
        if condition.operator == "has":
            return true()
        made = []
        for one in condition.values:
            first_us, length_us = _span(one)
            made.append(
                {
                    "=": and_(column >= first_us, column < first_us + length_us),
                    "<": column < first_us,
                    "<=": column < first_us + length_us,
                    ">": column >= first_us + length_us,
                    ">=": column >= first_us,
                }[condition.operator]
            )
        return _any(made)

    return compare


def _span(one: object) -> tuple[int, int]:
    """Return the start of a day in UTC, or a time, in microseconds since 1970, and its length in microseconds.

    The length of a time is 1.
    """
    if isinstance(one, datetime):
        return micros_of(one), 1
    assert isinstance(one, date)
    return (one - date(1970, 1, 1)) // timedelta(days=1) * DAY_US, DAY_US


def _name(condition: Condition, _: str) -> ColumnElement[bool]:
    if condition.operator == "has":
        return true()
    if condition.operator == "~":
        parts = [str(part).casefold() for part in condition.values]
        return _any([item.c.name_folded.contains(part, autoescape=True) for part in parts])
    return item.c.name.in_(condition.values)


def _path(condition: Condition, _: str) -> ColumnElement[bool]:
    place = collection.alias("place")  # the list itself may join the collections
    folder = select(place.c.path).where(place.c.id == item.c.collection_id).correlate(item).scalar_subquery()
    return _texts(case((folder == "", item.c.name), else_=folder + "/" + item.c.name), condition)


def _folder(condition: Condition, project_id: str) -> ColumnElement[bool]:
    """Return the SQL condition on the folder of an item.

    `=` matches items in the given folder and in folders below it; `~` matches a part of the folder's path.
    """
    own = collection.c.project_id == project_id
    if condition.operator == "has":
        chosen = collection.c.path != ""
    elif condition.operator == "~":
        chosen = _any([_contains(collection.c.path, part) for part in condition.values])
    else:
        chosen = _any([collections.at_or_below(str(path).strip("/")) for path in condition.values])
    return item.c.collection_id.in_(select(collection.c.id).where(own, chosen).correlate(None))


def _tag(condition: Condition, _: str) -> ColumnElement[bool]:
    own = item_tag.c.item_id == item.c.id
    return exists().where(own, _texts(item_tag.c.tag, condition)).correlate(item)


def frames_in_range(condition: Condition, _: str) -> ColumnElement[bool]:
    """Return the SQL condition on the number of frames, written so that a database can use the index of the column.

    It selects the same items as the condition in `COMPARISONS`, but compares the column with whole numbers. A list must
    not use this form, unless it reads only few items. Otherwise SQLite uses this index instead of the index by which
    the list is sorted, and has to sort all items that it finds.
    """
    numbers = [max(0.0, min(float(str(one)), _MOST_FRAMES)) for one in condition.values]
    if condition.operator == "=":
        return item.c.frames.in_([int(one) for one in numbers if one >= 1 and one.is_integer()])
    if condition.operator in (">", ">="):
        least = math.floor(numbers[0]) + 1 if condition.operator == ">" else math.ceil(numbers[0])
        return item.c.frames >= max(1, least)  # one limit only, because SQLite uses only the first
    most = math.ceil(numbers[0]) - 1 if condition.operator == "<" else math.floor(numbers[0])
    return item.c.frames.between(1, most)


def facet_meets(condition: Condition) -> ColumnElement[bool]:
    """Return the SQL condition that a row of `item_facet` meets a condition of a query on a facet."""
    named, value = item_facet.c.name == condition.field.removeprefix(FACET_PREFIX), item_facet.c.value  # never null
    if condition.operator == "has":
        return named
    if condition.operator == "=":
        return and_(named, value.in_(condition.values))
    return and_(named, _ordered(value, condition.operator, condition.values[0]))


def _facet(condition: Condition, _: str) -> ColumnElement[bool]:
    own = and_(item_facet.c.item_id == item.c.id, item_facet.c.number == item.c.head)
    return exists().where(own, facet_meets(condition)).correlate(item)


def _warning(condition: Condition, _: str) -> ColumnElement[bool]:
    """Return the SQL condition on the codes of warnings, stored as the text of a list: `["foot-slide", "gap"]`.

    Codes contain no quotation marks or commas.
    """
    stored: ColumnElement[Any] = item.c.summary["warnings"].as_string()
    if condition.operator == "has":
        return _is_true(and_(stored.is_not(None), stored != "[]"))
    parts = [str(part) for part in condition.values if not {'"', ",", "[", "]", " "} & set(str(part))]
    if condition.operator == "=":
        return _is_true(_any([stored.contains(f'"{part}"', autoescape=True) for part in parts if part]))
    return _is_true(_any([and_(_contains(stored, part), stored != "[]") for part in parts]))


def _skeleton(condition: Condition, project_id: str) -> ColumnElement[bool]:
    if condition.operator == "has":
        return item.c.skeleton_id.is_not(None)
    rig = item.alias("rig")
    named: ColumnElement[bool] = rig.c.name.in_(condition.values)
    if condition.operator == "~":
        parts = [str(part).casefold() for part in condition.values]
        named = _any([rig.c.name_folded.contains(part, autoescape=True) for part in parts])
    ids = select(rig.c.id).where(rig.c.project_id == project_id, rig.c.deleted_us.is_(None), named)
    found = item.c.skeleton_id.in_(ids)
    return _is_true(found if condition.operator == "~" else or_(found, item.c.skeleton_id.in_(condition.values)))


COMPARISONS: dict[str, Comparison] = {
    "name": _name,
    "path": _path,
    "folder": _folder,
    "tag": _tag,
    "revision": lambda condition, _: _numbers(item.c.head, condition),
    "created": _time_of(item.c.created_us),
    "updated": _time_of(item.c.updated_us),
    "frames": lambda condition, _: _numbers(func.nullif(item.c.frames, 0), condition),
    "duration": _number_of("duration_s"),
    "rate": _number_of("frame_rate_hz"),
    "joints": _number_of("joints"),
    "skeleton": _skeleton,
    "warning": _warning,
    "subject": _text_of("subject"),
    "action": _text_of("action"),
    "take": _text_of("take"),
    "shoot_day": _day_of("shoot_day"),
    "select": _text_of("select"),
    "licence": _text_of("licence"),
    "capture_system": _text_of("capture_system"),
    "consent_until": _day_of("consent_until"),
}
"""Functions that convert a condition to SQL, by the name of the field."""
assert set(COMPARISONS) == set(FIELDS), "every field of queries needs a comparison"
