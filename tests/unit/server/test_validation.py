"""Validation of query parameters and bodies by their models."""

import json
from typing import Any

import numpy as np
import pytest
from pydantic import Field
from tests.support.present import present

from marey_schemas.access import ProjectCreate
from marey_schemas.items import ItemCreate, UploadCreate
from marey_schemas.queue.jobs import JobCreate
from marey_server.errors import BadRequestProblem, InvalidProblem
from marey_server.http.queries import CommaSeparated, PageQuery
from marey_server.http.validation import decode_body, parse_query, validate_body


class Query(PageQuery):
    """Query parameters for tests."""

    tag_in: CommaSeparated = Field((), alias="tag.in")


def pointers(refusal: pytest.ExceptionInfo[Any]) -> set[str]:
    return {error.pointer for error in refusal.value.errors}


def test_parameters_are_read_by_the_names_they_have_in_addresses() -> None:
    query = parse_query(Query, {"limit": [b"7"], "tag.in": [b"a,b"]})
    assert (present(query).limit, present(query).tag_in) == (7, ("a", "b"))


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [
        ({"colour": [b"red"]}, {"colour"}),
        ({"tag_in": [b"a"]}, {"tag_in"}),
        ({"limit": [b"1", b"2"]}, {"limit"}),
        ({"limit": [b"0"], "cursor": [b"a b"]}, {"limit", "cursor"}),
        ({"cursor": [b"\xff"]}, {"cursor"}),
        ({"cursor": [b"a\x00"]}, {"cursor"}),
        ({"tag.in": [b"," * 300]}, {"tag.in"}),
    ],
)
def test_each_wrong_parameter_is_named(arguments: dict[str, list[bytes]], wrong: set[str]) -> None:
    with pytest.raises(BadRequestProblem) as refusal:
        parse_query(Query, arguments)
    assert pointers(refusal) == wrong


def test_where_nothing_can_be_asked_every_parameter_is_unknown() -> None:
    assert parse_query(None, {}) is None
    with pytest.raises(BadRequestProblem):
        parse_query(None, {"limit": [b"1"]})


def test_a_body_that_is_no_document_is_a_bad_request_and_one_that_may_not_travel_is_invalid() -> None:
    with pytest.raises(BadRequestProblem):
        decode_body(b"{", "application/json", max_array_bytes=0)
    with pytest.raises(BadRequestProblem):
        decode_body(b"\xff", "application/bson", max_array_bytes=0)
    with pytest.raises((BadRequestProblem, InvalidProblem)):
        decode_body(b'{"a": NaN}', "application/json", max_array_bytes=0)


def test_a_whole_number_is_an_integer_however_it_is_spelt() -> None:
    assert validate_body(UploadCreate, json.loads('{"length": 5.0}')).length == 5
    for spelling in ("5", True, 5.5, None):
        with pytest.raises(InvalidProblem):
            validate_body(UploadCreate, {"length": spelling})


def test_faults_point_into_the_body_even_inside_alternatives() -> None:
    with pytest.raises(InvalidProblem) as refusal:
        validate_body(JobCreate, {"kind": "x", "inputs": {"clips": [{"item": "a", "revision": 0}]}, "priority": 1000})
    assert "/priority" in pointers(refusal)
    assert any(pointer.startswith("/inputs/clips") for pointer in pointers(refusal))
    assert not any("ItemInput" in pointer for pointer in pointers(refusal))


def test_a_missing_field_is_pointed_at_where_it_should_be() -> None:
    with pytest.raises(InvalidProblem) as refusal:
        validate_body(ProjectCreate, {})
    assert pointers(refusal) == {"/name"}


def test_a_body_that_is_no_object_is_refused_without_a_look_at_its_items() -> None:
    with pytest.raises(InvalidProblem) as caught:
        validate_body(ProjectCreate, ["no\0"])
    assert [(fault.pointer, fault.code) for fault in caught.value.errors or ()] == [("", "model-type")]


def test_arrays_pass_through_untouched() -> None:
    array = np.zeros((2, 3), "<f4")
    made = validate_body(ItemCreate, {"name": "n", "parts": {"motion": {"poses": array}}})
    assert made.parts["motion"]["poses"] is array


def test_nul_is_found_however_deep() -> None:
    with pytest.raises(InvalidProblem) as refusal:
        validate_body(ItemCreate, {"name": "n", "parts": {"a/b": {"c": ["ok", "no\0"]}}})
    assert pointers(refusal) == {"/parts/a~1b/c/1"}
