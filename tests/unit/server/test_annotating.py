"""Refusals of annotations that are imported."""

from __future__ import annotations

import json

import pytest

from marey_client.errors import RequestFailed
from marey_schemas.editing.annotation_commands import AnnotationImport
from marey_schemas.imports import ImportFile
from marey_schemas.problems import Problem
from marey_server.errors import InvalidProblem
from marey_server.motions.annotating import AnnotationOrder, read_annotation

DIGEST = f"sha256:{'1' * 64}"


def refusal(content: bytes) -> InvalidProblem:
    given = AnnotationImport(file=ImportFile(name="in/notes.json", blob=DIGEST))
    order = AnnotationOrder(content=content, clip="itm_1", revision=1, frame_count=10, given=given)
    with pytest.raises(InvalidProblem) as refused:
        read_annotation(order.pack())
    return refused.value


@pytest.mark.parametrize(
    ("content", "reason"), [(b"BZh9 damaged", "the bz2 data is damaged"), (b'{"sections": 1}', "sections")]
)
def test_the_refusal_of_a_file_says_its_reason_once_and_speaks_of_a_file(content: bytes, reason: str) -> None:
    problem = refusal(content)
    told = Problem(
        type="about:blank", title="", status=422, detail=problem.detail, instance="", code="", errors=problem.errors
    )
    text = str(RequestFailed(told))
    assert text.startswith("/file: The file is not a valid annotation of the clip: notes.json: ")
    assert text.count(reason) == 1
    assert "document is not" not in text


@pytest.mark.parametrize("label", ["\ud800", "x" * 300_000], ids=["half of a pair", "long"])
@pytest.mark.parametrize("frames", [[1, 2, 3], "x"])
def test_labels_that_no_annotation_may_have_are_refused_in_a_short_text(label: str, frames: object) -> None:
    detail = refusal(json.dumps({"semantic_annotation": {label: frames}}).encode()).detail
    assert len(detail.encode()) < 20_000
