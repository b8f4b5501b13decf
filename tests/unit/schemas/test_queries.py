"""Grammar of queries."""

from __future__ import annotations

from datetime import UTC, date, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_schemas.queries.fields import FIELDS, OPERATORS
from marey_schemas.queries.grammar import (
    DEEPEST,
    MOST_CHARACTERS,
    MOST_COMPARED_VALUES,
    MOST_CONDITIONS,
    Condition,
    Junction,
    Likeness,
    Negation,
    Query,
    QueryError,
    likenesses_of,
    parse,
    parts_of,
    with_clips,
)
from marey_schemas.queries.matching import QueriedFacts, matches


def plain(query: Query) -> object:
    """Return a query without the source texts of its conditions."""
    if isinstance(query, Likeness):
        return ("like", *query.moment, query.metric, "<" if query.below else "<=", query.distance)
    if isinstance(query, Condition):
        return (query.field, query.operator, *query.values)
    if isinstance(query, Negation):
        return ("not", plain(query.query))
    return (query.word, *map(plain, query.queries))


def test_and_binds_stronger_than_or_and_not_stronger_than_both() -> None:
    assert plain(parse("has tag or has take and not has select")) == (
        "or",
        ("tag", "has"),
        ("and", ("take", "has"), ("not", ("select", "has"))),
    )
    assert plain(parse("(has tag or has take) and not (has select)")) == (
        "and",
        ("or", ("tag", "has"), ("take", "has")),
        ("not", ("select", "has")),
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("subject = 02", ("subject", "=", "02")),
        ("SUBJECT=02", ("subject", "=", "02")),
        ("frames >= 1e3", ("frames", ">=", 1000.0)),
        ("tag in (night, 'a day')", ("tag", "=", "night", "a day")),
        ('action ~ "say \\"hi\\""', ("action", "~", 'say "hi"')),
        ("select != best", ("not", ("select", "=", "best"))),
        ("name = and", ("name", "=", "and")),
        ('LIKE ("a b/c:30-90") < 0.2', ("like", "a b/c", (30, 90), None, "<", 0.2)),
        ("like(c:3, published/sigmoid) <= 1", ("like", "c", (3, 4), "published/sigmoid", "<=", 1.0)),
        ("name = like", ("name", "=", "like")),
        ("action = order", ("action", "=", "order")),
        ("path = walks/take-01.a", ("path", "=", "walks/take-01.a")),
        ("name ~ Übung", ("name", "~", "Übung")),
        ("created > 2026-11-23", ("created", ">", date(2026, 11, 23))),
        ("created > 2026-11-23T10:00", ("created", ">", datetime(2026, 11, 23, 10, tzinfo=UTC))),
        ("has consent_until", ("consent_until", "has")),
    ],
)
def test_conditions_are_read(text: str, expected: object) -> None:
    assert plain(parse(text)) == expected


@pytest.mark.parametrize(
    ("text", "column", "said"),
    [
        ("", 1, "empty"),
        ("frames", 7, "ends too early"),
        ("frames >", 9, "expected a field or a value"),
        ("frames > many", 10, "'many' is not a number"),
        ("frames > nan", 10, "not a number"),
        ("framse > 1", 1, "did you mean 'frames'"),
        ("not_x = 1", 1, "there is no field 'not_x'"),
        ("frames ~ 1", 8, "compare it with =, !=, <, <=, >, >= or in"),
        ("subject > 02", 9, "compare it with"),
        ("frames > 1 frames < 2", 12, "expected the end, 'and' or 'or'"),
        ("(has tag", 9, "closing bracket"),
        ("has tag)", 8, "expected"),
        ("tag in ()", 9, "expected"),
        ('tag = "open', 7, "quotation marks"),
        ("created = 2026-13-01", 11, "not a date"),
        ('name = "a\0b"', 10, "NUL"),
        ("subject == 02", 10, "write one equals sign, such as subject = 02"),
        ("has tag and " * MOST_CONDITIONS + "has tag", 1, f"at most {MOST_CONDITIONS} conditions"),
        ("has tag" + " " * MOST_CHARACTERS, 1, "characters"),
        ("(" * (DEEPEST + 1) + "has tag" + ")" * (DEEPEST + 1), DEEPEST + 1, "brackets"),
        (f"tag in ({','.join('x' * (MOST_COMPARED_VALUES + 1))})", 1, f"{MOST_COMPARED_VALUES} values"),
    ],
)
def test_an_error_names_the_place_and_what_is_expected(text: str, column: int, said: str) -> None:
    with pytest.raises(QueryError, match=f"^query, column {column}: ") as refused:
        parse(text)
    assert said in str(refused.value)
    assert refused.value.column == column


@pytest.mark.parametrize("field", sorted(FIELDS.keys() - {"name", "path", "folder", "tag"}))
def test_no_condition_on_a_missing_fact_is_met(field: str) -> None:
    facts = QueriedFacts(name="walk", folder="raw", tags=("night",))
    value = {"text": "''", "number": "1", "date": "2026-11-27"}[FIELDS[field].type]
    operators = [one for one in OPERATORS[FIELDS[field].type] if one not in ("has", "in", "!=")]
    for condition in (f"has {field}", f"{field} in ({value}, {value})", *(f"{field} {o} {value}" for o in operators)):
        assert not matches(parse(condition), facts), condition


def test_parts_are_what_and_joins() -> None:
    query = parse("has tag and (has take or has select) and frames > 1")
    assert [part.source for part in parts_of(query)] == ["has tag", "has take or has select", "frames > 1"]
    assert isinstance(query, Junction)
    assert [part.source for part in parts_of(parse("has tag or has take"))] == ["has tag or has take"]


WORDS = [
    *FIELDS, "and", "or", "not", "in", "has", "=", "!=", "<", "~", "(", ")", ",", "1", "2026-11-23", "é", '"', "\\",
]  # fmt: skip


@given(st.lists(st.sampled_from(WORDS) | st.text(max_size=3), max_size=25), st.sampled_from(["", " ", "\n"]))
def test_any_text_is_read_or_refused(words: list[str], between: str) -> None:
    text = between.join(words)
    refused: QueryError | None = None
    try:
        parse(text)
    except QueryError as error:
        refused = error
    assert refused is None or 1 <= refused.column <= len(text) + 1


@given(st.text(st.characters(exclude_characters="\0"), min_size=1, max_size=40))
def test_any_value_can_be_quoted(value: str) -> None:
    quoted = value.replace("\\", "\\\\").replace('"', '\\"')
    assert plain(parse(f'subject = "{quoted}"')) == ("subject", "=", value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("like(a) < 1", "column 6: 'a' names no frames"),
        ("like(a:9-3) < 1", "column 6: 'a:9-3': the end, frame 3, must be after"),
        ("like(a:1) > 2", "column 11: like(...) is a distance of motions; compare it with < or <="),
        ("like(a:1) < -2", "column 13: the distance must not be negative"),
        ("like(a:1, '') < 2", "column 11: the name of the metric is empty"),
        ("like = 3", "column 1: write like("),
        (" or ".join(["like(a:1) < 1"] * 4), "at most 3 conditions like"),
    ],
)
def test_a_comparison_of_motions_says_what_is_wrong(text: str, reason: str) -> None:
    with pytest.raises(QueryError) as refused:
        parse(text)
    assert reason in str(refused.value)


def test_clips_that_were_found_are_added_to_their_conditions() -> None:
    query = with_clips(parse("frames > 3 and not (like(a:1) < 1 or like(b:1) < 1)"), {"like(a:1) < 1": frozenset("x")})
    assert [one.clips for one in likenesses_of(query)] == [frozenset("x"), None]
