"""Queries that select clips and other items, such as `subject = 02 and frames > 120 and not warning = foot-slide`.

`parse` turns the text of a query into conditions over the fields in `FIELDS`. Every condition is either true or false
for an item. A condition about a value that the item does not have is false, and the negation of this condition is true.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

from marey_schemas.queries.fields import OPERATORS, QueryField, field_names, find_field
from marey_schemas.queries.moments import Moment, read_moment
from marey_schemas.wording import one_of, suggestion

if TYPE_CHECKING:
    from lark import Lark

MOST_CHARACTERS = 2_000
MOST_CONDITIONS = 50
MOST_COMPARED_VALUES = 200
"""Greatest number of values in all conditions of a query together."""
MOST_LIKENESSES = 3
"""Greatest number of conditions `like(...)` in a query; each of them searches an index of motions."""
MOST_ALIKE = 10_000
"""Greatest number of clips that may meet a condition `like(...)`, because the SQL statement contains their ids."""
DEEPEST = 30
"""Greatest number of brackets that may be open at the same time."""

Operator = Literal["=", "~", "<", "<=", ">", ">=", "has"]
"""Operators of conditions. The parser expresses `!=` as a negated `=`, and `in` as `=` with several values."""
_GRAMMAR = r"""
    ?start: disjunction
    ?disjunction: conjunction (_OR conjunction)*
    ?conjunction: negation (_AND negation)*
    ?negation: _NOT negation -> negated
        | "(" disjunction ")" -> bracketed
        | comparison
    comparison: WORD OPERATOR _value
        | WORD _IN "(" _value ("," _value)* ")" -> membership
        | _HAS WORD -> presence
        | _LIKE _value ["," _value] ")" OPERATOR _value -> likeness
    _value: WORD | TEXT
    OPERATOR: "!=" | "<=" | ">=" | "=" | "~" | "<" | ">"
    TEXT: /"([^"\\]|\\.)*"/s | /'([^'\\]|\\.)*'/s
    _AND: /and(?![^\s()"',=~<>!\\])/i
    _OR: /or(?![^\s()"',=~<>!\\])/i
    _NOT: /not(?![^\s()"',=~<>!\\])/i
    _IN: /in(?![^\s()"',=~<>!\\])/i
    _HAS: /has(?![^\s()"',=~<>!\\])/i
    _LIKE: /like\s*\(/i
    WORD.-1: /[^\s()"',=~<>!\\]+/
    %ignore /\s+/
"""


class QueryError(ValueError):
    """Error of a query that cannot be understood; `column` is the place of the fault, counted from 1."""

    def __init__(self, message: str, column: int) -> None:
        super().__init__(f"query, column {column}: {message}")
        self.column = column


@dataclass(frozen=True, slots=True)
class Condition:
    """Comparison of a field with one or more values; it is true if at least one value matches.

    The operator `has` takes no values; the condition is then true if the item has the field. Values are numbers for
    fields of the type `number`, and texts for the type `text`. For the type `date`, they are dates, or times with a
    time zone.
    """

    field: str
    operator: Operator
    values: tuple[str | float | date | datetime, ...]
    source: str
    """The condition as the user wrote it."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """Condition that a clip has a moment that looks like some frames of a clip: `like("walks/a:30-90") < 0.2`.

    The database cannot evaluate this condition. So an index of motions is searched first, and `with_clips` adds the
    found clips to the condition.
    """

    moment: Moment
    metric: str | None
    """Name of a built-in metric, or path of a stored one; None: the default."""
    distance: float
    below: bool
    """Whether clips at exactly the given distance are excluded (`<`), or included (`<=`)."""
    source: str
    column: int
    clips: frozenset[str] | None = None
    """Ids of the clips that meet the condition; None: not searched."""


@dataclass(frozen=True, slots=True)
class Negation:
    """Query that selects the items that another query does not select."""

    query: Query
    source: str


@dataclass(frozen=True, slots=True)
class Junction:
    """Queries joined by `and` or by `or`: with `and`, all of them must be true; with `or`, at least one."""

    word: Literal["and", "or"]
    queries: tuple[Query, ...]
    source: str


Query = Condition | Likeness | Negation | Junction


def parse(text: str) -> Query:
    """Parse the text of a query. Raises `QueryError`, which says where the text is wrong and what is expected there."""
    from lark.exceptions import UnexpectedCharacters, UnexpectedEOF, UnexpectedToken

    if len(text) > MOST_CHARACTERS:
        raise QueryError(f"the query has {len(text)} characters; at most {MOST_CHARACTERS} are accepted", 1)
    if "\0" in text:
        raise QueryError("the query contains a NUL character; remove it", text.index("\0") + 1)
    if not text.strip():
        raise QueryError("the query is empty; write a condition, such as frames > 120", 1)
    _require_shallow(text)
    try:
        tree = _parser().parse(text)
    except UnexpectedCharacters as error:
        at = error.pos_in_stream or 0
        raise QueryError(f"{text[at]!r} is not expected here; {_QUOTE}", at + 1) from None
    except (UnexpectedToken, UnexpectedEOF) as error:
        raise _unexpected(text, error) from None
    query = _Reader(text).read(tree)
    conditions = list(conditions_of(query))
    if len(conditions) > MOST_CONDITIONS or sum(len(one.values) for one in conditions) > MOST_COMPARED_VALUES:
        raise QueryError(
            f"the query is too long: it may have at most {MOST_CONDITIONS} conditions, with "
            f"{MOST_COMPARED_VALUES} values in total",
            1,
        )
    if len(alike := list(likenesses_of(query))) > MOST_LIKENESSES:
        raise QueryError(
            f"a query may have at most {MOST_LIKENESSES} conditions like(...); remove the others", alike[-1].column
        )
    return query


def conditions_of(query: Query) -> Iterator[Condition]:
    """Yield all conditions on fields in a query."""
    return (one for one in _leaves(query) if isinstance(one, Condition))


def likenesses_of(query: Query) -> Iterator[Likeness]:
    """Yield all conditions `like(...)` of a query."""
    return (one for one in _leaves(query) if isinstance(one, Likeness))


def _leaves(query: Query) -> Iterator[Query]:
    """Yield the parts of a query that contain no other query, from left to right."""
    if isinstance(query, Negation):
        yield from _leaves(query.query)
    elif isinstance(query, Junction):
        for part in query.queries:
            yield from _leaves(part)
    else:
        yield query


def with_clips(query: Query, found: Mapping[str, frozenset[str]]) -> Query:
    """Return a copy of a query with the found clips in each condition `like(...)`; `found` maps sources to clips."""
    if isinstance(query, Likeness):
        return replace(query, clips=found.get(query.source))
    if isinstance(query, Negation):
        return replace(query, query=with_clips(query.query, found))
    if isinstance(query, Junction):
        return replace(query, queries=tuple(with_clips(part, found) for part in query.queries))
    return query


def parts_of(query: Query) -> tuple[Query, ...]:
    """Return the queries that `and` joins at the top level of a query; the query itself if there is no such `and`."""
    return query.queries if isinstance(query, Junction) and query.word == "and" else (query,)


def operands_of(query: Query) -> Iterator[Query]:
    """Yield the smallest queries that are joined by `and`: for `a and (b and c)`, these are `a`, `b` and `c`.

    The query is true if all of them are true. None of them is itself a junction with `and`.
    """
    for part in parts_of(query):
        if part is query:
            yield query
        else:
            yield from operands_of(part)


@cache
def _parser() -> Lark:
    from lark import Lark

    return Lark(_GRAMMAR, parser="lalr", propagate_positions=True, maybe_placeholders=False)


def _require_shallow(text: str) -> None:
    """Raise `QueryError` if the query has too many nested brackets or too many negations to be parsed.

    Brackets and negations between quotation marks count, too.
    """
    depth = 0
    for column, character in enumerate(text, 1):
        depth += (character == "(") - (character == ")")
        if depth > DEEPEST:
            raise QueryError(f"more than {DEEPEST} brackets are open; use fewer nested brackets", column)
    if len([word for word in text.lower().split() if word == "not"]) > MOST_CONDITIONS:
        raise QueryError(f"a query may have at most {MOST_CONDITIONS} negations; remove the others", 1)


_QUOTE = "put values with spaces or special characters between quotation marks"
_EXPECTED = {
    "OPERATOR": "an operator such as = or >",
    "WORD": "a field or a value",
    "TEXT": "",
    "LPAR": "an opening bracket",
    "RPAR": "a closing bracket",
    "COMMA": "a comma",
    "_AND": "'and'",
    "_OR": "'or'",
    "_NOT": "'not'",
    "_IN": "'in'",
    "_HAS": "'has'",
    "_LIKE": "'like('",
    "$END": "the end",
}


def _unexpected(text: str, error: Any) -> QueryError:
    """Return the error for a word in the wrong place."""
    token = getattr(error, "token", None)
    accepted: set[str] = getattr(error, "accepts", None) or getattr(error, "expected", None) or set()
    names = sorted(accepted)
    expected = one_of([_EXPECTED[name] for name in names if _EXPECTED[name]])
    if token is None or token.type == "$END":
        return QueryError(f"the query ends too early; expected {expected}", len(text.rstrip()) + 1)
    if text[max(_column(token) - 2, 0) : _column(token)] == "==":
        return QueryError("write one equals sign, such as subject = 02", _column(token))
    return QueryError(f"expected {expected}, but found {str(token)!r}", _column(token))


class _Reader:
    """Conversion of a syntax tree to a query, with checks of fields and values."""

    def __init__(self, text: str) -> None:
        self._text = text

    def read(self, tree: Any) -> Query:
        """Return the query that a node of the syntax tree states."""
        source = self._text[tree.meta.start_pos : tree.meta.end_pos]
        if tree.data == "bracketed":
            return self.read(tree.children[0])
        if tree.data == "negated":
            return Negation(self.read(tree.children[0]), source)
        if tree.data in ("conjunction", "disjunction"):
            word: Literal["and", "or"] = "and" if tree.data == "conjunction" else "or"
            return Junction(word, tuple(self.read(child) for child in tree.children), source)
        if tree.data == "likeness":
            return _likeness(tree, source)
        return self._condition(tree, source)

    def _condition(self, tree: Any, source: str) -> Query:
        field = str(tree.children[0]).lower()
        known = _require_field(tree.children[0])
        if tree.data == "presence":
            return Condition(field, "has", (), source)
        if tree.data == "membership":
            values = tuple(_value(known, token) for token in tree.children[1:])
            return Condition(field, "=", values, source)
        operator = tree.children[1]
        if str(operator) not in OPERATORS[known.type]:
            allowed = one_of([name for name in OPERATORS[known.type] if name != "has"])  # which compares nothing
            raise QueryError(f"the field {field!r} is a {known.type}; compare it with {allowed}", _column(operator))
        value = _value(known, tree.children[2])
        if operator == "!=":
            return Negation(Condition(field, "=", (value,), source), source)
        return Condition(field, operator.value, (value,), source)


def _likeness(tree: Any, source: str) -> Likeness:
    moment, *metric, operator, limit = tree.children
    if operator not in ("<", "<="):
        raise QueryError("like(...) is a distance of motions; compare it with < or <=", _column(operator))
    try:
        parsed = read_moment(_text(moment))
    except ValueError as error:
        raise QueryError(str(error), _column(moment)) from None
    distance = _number(_text(limit), _column(limit))
    if distance < 0:
        raise QueryError("the distance must not be negative", _column(limit))
    named = _text(metric[0]) if metric else None
    if named == "":
        raise QueryError(
            "the name of the metric is empty; name a metric, or leave it out to use the default metric",
            _column(metric[0]),
        )
    return Likeness(parsed, named, distance, operator == "<", source, int(tree.meta.start_pos) + 1)


def _column(token: Any) -> int:
    """Return the place of a word in the whole query, counted from 1."""
    return int(token.start_pos) + 1


def _require_field(token: Any) -> QueryField:
    name = str(token).lower()
    if (field := find_field(name)) is not None:
        return field
    if name == "like":
        raise QueryError('write like("walks/take-01:30-90") < 0.2, with a clip and its frames', _column(token))
    raise QueryError(f"there is no field {str(token)!r}; {suggestion(name, field_names(), 'fields')}", _column(token))


def _value(field: QueryField, token: Any) -> str | float | date | datetime:
    text = _text(token)
    if field.type == "text":
        return text
    if field.type == "number":
        return _number(text, _column(token))
    return _date(text, _column(token))


def _text(token: Any) -> str:
    return _unquoted(str(token)[1:-1]) if token.type == "TEXT" else str(token)


def _unquoted(text: str) -> str:
    """Return the content of a quoted text without the backslashes that escape characters."""
    characters = iter(text)
    return "".join(next(characters) if character == "\\" else character for character in characters)


def _number(text: str, column: int) -> float:
    try:
        number = float(text)
    except ValueError:
        raise QueryError(f"{text!r} is not a number", column) from None
    if not abs(number) < 1e15:
        raise QueryError(f"{text!r} is not a number between -1e15 and 1e15", column)
    return number


def _date(text: str, column: int) -> date | datetime:
    try:
        if len(text) == len("2026-11-23"):
            return date.fromisoformat(text)
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise QueryError(f"{text!r} is not a date; write it as 2026-11-23 or 2026-11-23T15:04:05Z", column) from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
