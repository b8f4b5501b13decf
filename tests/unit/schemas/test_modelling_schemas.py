"""Records of a model's training: members that Marey uses later are validated; others are only stored."""

from typing import Any

import pytest
from pydantic import ValidationError
from tests.support import predecessor_models as models
from tests.support.predecessor_models import FILE

from marey_schemas.documents.models import MotionPrimitiveDocument, log_likelihoods, predecessor_origin


@pytest.fixture(scope="module")
def model() -> dict[str, Any]:
    return models.imported()[0]["model"]


@pytest.mark.parametrize(
    ("notes", "place"),
    [
        ({"provenance": {"predecessor": "x"}}, "provenance/predecessor"),
        ({"provenance": {"predecessor": {"original": "x"}}}, "provenance/predecessor/original"),
        ({"provenance": {"predecessor": {"original": {}}}}, "provenance/predecessor/original/blob"),
        (
            {"provenance": {"predecessor": {"tree": {"blob": FILE, "content": 5}}}},
            "provenance/predecessor/tree/content",
        ),
        ({"provenance": {"predecessor": {"animated_joints": 5}}}, "provenance/predecessor/animated_joints"),
        ({"training": {"examples": 5}}, "training/examples"),
        ({"training": {"examples": [1]}}, "training/examples/0"),
        ({"training": {"examples": [{"log_likelihood": "a"}]}}, "training/examples/0/log_likelihood"),
        ({"training": {"examples": [{"log_likelihood": float("nan")}]}}, "training/examples/0/log_likelihood"),
    ],
)
def test_notes_that_could_not_be_read_again_are_refused_with_their_place(
    model: dict[str, Any], notes: dict[str, Any], place: str
) -> None:
    with pytest.raises(ValidationError) as refused:
        MotionPrimitiveDocument.model_validate({**model, **notes})
    assert "/".join(map(str, refused.value.errors()[0]["loc"])) == place


def test_other_notes_may_stand_beside_them(model: dict[str, Any]) -> None:
    notes = {
        "provenance": {"digest_of": ["x"], "predecessor": {"layout": "3"}, "set": 5},
        "training": {"examples": [{"name": "a", "odd": True}, {"log_likelihood": 2.0}], "warnings": ["any"]},
    }
    noted = {**model, **notes}
    MotionPrimitiveDocument.model_validate(noted)
    assert log_likelihoods(noted) == (2.0,)
    assert predecessor_origin(noted).original is None


@pytest.mark.parametrize(
    "training", [None, {}, {"examples": 5}, {"examples": [1]}, {"examples": [{"log_likelihood": "a"}]}]
)
def test_an_older_document_with_odd_likelihoods_has_none(training: dict[str, Any] | None) -> None:
    assert log_likelihoods({"training": training}) == ()


def test_an_older_document_with_odd_notes_comes_from_nowhere() -> None:
    assert predecessor_origin({"provenance": {"predecessor": "x"}}) == predecessor_origin({})
