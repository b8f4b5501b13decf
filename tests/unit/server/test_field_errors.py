"""Errors of fields: the same form for request bodies, documents, and parameters of jobs."""

from typing import Annotated, Any

import pytest
from hypothesis import given, strategies
from pydantic import BaseModel, Field, ValidationError

from marey_schemas.editing.commands import Resample, Trim
from marey_schemas.editing.edits import EditDocument
from marey_schemas.problems import FieldError
from marey_schemas.queue.jobs import JobCreate
from marey_server.errors import InvalidProblem
from marey_server.field_errors import MAX_ERRORS, field_errors, json_pointer
from marey_server.prepared_documents import prepare_document

BACKWARDS = {"command": "trim", "start": 5, "stop": 2}


def told(model: type[BaseModel], tree: dict[str, Any]) -> list[FieldError]:
    with pytest.raises(ValidationError) as refused:
        model.model_validate(tree)
    return field_errors(refused.value, model, tree)


def test_pointers_escape_as_rfc_6901_says() -> None:
    assert json_pointer(["a/b", "m~n", "0"]) == "/a~1b/m~0n/0"


def test_a_rule_of_ours_is_told_in_its_own_words() -> None:
    (fault,) = told(Trim, BACKWARDS)
    assert (fault.pointer, fault.code) == ("", "value-error")
    assert fault.detail == "the stop, frame 2, must be after the start, frame 5"


def test_a_fault_of_a_document_is_told_as_one_of_a_body() -> None:
    tree = {"schema": "marey/edit@1", "commands": [BACKWARDS | {"name/of~it": 1}]}
    with pytest.raises(InvalidProblem) as refused:
        prepare_document(tree)
    assert list(refused.value.errors) == told(EditDocument, tree)
    first = refused.value.errors[0]
    assert (first.pointer, first.code) == ("/commands/0/name~1of~0it", "extra-forbidden")


def test_the_pointer_of_a_missing_field_names_the_field_but_no_member_of_a_union() -> None:
    (missing,) = told(Resample, {"command": "resample"})
    assert (missing.pointer, missing.code) == ("/frame_rate_hz", "missing")
    (inner,) = told(EditDocument, {"schema": "marey/edit@1", "commands": [{"command": "resample"}]})
    assert (inner.pointer, inner.code) == ("/commands/0/frame_rate_hz", "missing")


def test_a_list_is_too_short_only_if_it_is_so_in_the_document() -> None:
    (short,) = told(EditDocument, {"schema": "marey/edit@1", "commands": []})
    assert (short.pointer, short.code) == ("/commands", "too-short")


def test_only_so_many_faults_are_told() -> None:
    assert len(told(Trim, {"command": "trim", **{f"f{number}": 1 for number in range(100)}})) == MAX_ERRORS


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("raw", {"": ["the value must be an object with named fields; or the value must be a list"]}),
        ({}, {"": ["give 'item', 'collection', 'dataset' or 'job'"]}),
        ([{"item": "clip_1"}, {}], {"/1": ["give 'item', 'collection', 'dataset' or 'job'"]}),
        ({"colection": "raw"}, {"/colection": ["there is no field of this name; did you mean 'collection'?"]}),
        ({"item": "clip_1", "revision": "two"}, {"/revision": ["the value must be a whole number"]}),
        ([{"item": "clip_1"}, 3], {"/1": ["the value must be an object with named fields"]}),
        (
            {"item": "clip_1", "job": "job_1"},
            {field: ["this field cannot be combined with the others of this object"] for field in ("/item", "/job")},
        ),
    ],
)
def test_of_the_types_of_a_value_only_the_likeliest_counts(given: Any, expected: dict[str, list[str]]) -> None:
    found: dict[str, list[str]] = {}
    for fault in told(JobCreate, {"kind": "retarget", "inputs": {"clips": given}}):
        found.setdefault(fault.pointer.removeprefix("/inputs/clips"), []).append(fault.detail)
    assert found == expected


NAMES = strategies.sampled_from(("item", "collection", "dataset", "job", "revision", "ref", "recursive", "tags", "x"))
ANYTHING = strategies.recursive(
    strategies.none() | strategies.booleans() | strategies.integers(-2, 2) | strategies.sampled_from(("", "x", "a/b")),
    lambda inner: strategies.lists(inner, max_size=3) | strategies.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


@given(inputs=ANYTHING)
def test_whatever_is_refused_has_an_error_at_a_place_that_exists(inputs: Any) -> None:
    tree = {"kind": "retarget", "inputs": {"clips": inputs}}
    try:
        JobCreate.model_validate(tree)
    except ValidationError as error:
        found = field_errors(error, JobCreate, tree)
        assert found
        for fault in found:
            place: Any = tree
            *steps, last = fault.pointer.split("/")[1:]
            for step in steps:
                place = place[int(step)] if isinstance(place, list) else place[step]
            assert isinstance(place, dict) or int(last) < len(place)


class Lengths(BaseModel):
    lengths_m: dict[Annotated[str, Field(max_length=2)], int]


def test_a_name_and_its_value_have_errors_of_their_own() -> None:
    assert [(fault.pointer, fault.code) for fault in told(Lengths, {"lengths_m": {"long": "x"}})] == [
        ("/lengths_m/long", "string-too-long"),
        ("/lengths_m/long", "int-parsing"),
    ]
