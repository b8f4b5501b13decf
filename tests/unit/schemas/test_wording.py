from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from marey_schemas.names import FORMS, CollectionPath, ItemName, ProjectName, Tag, UserName
from marey_schemas.wording import counted, plain_reason


@pytest.mark.parametrize(
    ("number", "told"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (103_568, "103,568 frames")]
)
def test_a_noun_takes_an_s_unless_there_is_exactly_one(number: int, told: str) -> None:
    assert counted(number, "frame") == told


@pytest.mark.parametrize(
    ("noun", "told"), [("trajectory", "2 trajectories"), ("day", "2 days"), ("index", "2 indexes")]
)
def test_a_noun_in_y_or_x_takes_the_plural_of_its_kind(noun: str, told: str) -> None:
    assert counted(2, noun) == told


@pytest.mark.parametrize(
    ("form", "wrong", "told"),
    [
        (ProjectName, "My Lab", "at most 64 lower-case letters"),
        (UserName, "Ann!", "letters, digits, dots"),
        (ItemName, "a/b", "no slash"),
        (CollectionPath, "/raw/", "names joined by single slashes"),
        (Tag, "a,b", "no comma"),
    ],
)
def test_a_refused_text_is_explained_in_words_and_not_by_its_pattern(form: Any, wrong: str, told: str) -> None:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(form).validate_python(wrong)
    reason = plain_reason(refused.value.errors()[0]["msg"])
    assert told in reason
    assert not any(pattern in reason for pattern in FORMS)
    assert "another form" in plain_reason("String should match pattern '^x$'")
    assert plain_reason("Input should be 'a' or 'b'") == "Input should be 'a' or 'b'"
