from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

import marey_schemas
from marey_schemas.editing.edits import EditDocument
from marey_schemas.names import FORMS, CollectionPath, ItemName, ProjectName, ReceivingPath, Tag, UserName
from marey_schemas.validation.reasons import first_reason, plain_reason


@pytest.mark.parametrize(
    ("form", "wrong", "expected"),
    [
        (ProjectName, "My Lab", "at most 64 lower-case letters"),
        (UserName, "Ann!", "letters, digits, dots"),
        (ItemName, "a/b", "no slash"),
        (CollectionPath, "/raw/", "names joined by single slashes"),
        (ReceivingPath, "raw/../x", "must not contain . or .."),
        (Tag, "a,b", "no comma"),
    ],
)
def test_a_refused_text_is_explained_in_words_and_not_by_its_pattern(form: Any, wrong: str, expected: str) -> None:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(form).validate_python(wrong)
    reason = plain_reason(refused.value.errors()[0])
    assert expected in reason
    assert not any(pattern in reason for pattern in FORMS)


class Exercise(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["exercise"]
    weight_kg: float = Field(1.0, gt=0.5, le=200)


class Walk(BaseModel):
    kind: Literal["walk"]
    steps: int = Field(1, ge=1, lt=100)


class Session(BaseModel):
    model_config = ConfigDict(extra="forbid")
    parts: list[Annotated[Exercise | Walk, Field(discriminator="kind")]] = Field([], max_length=2)
    unit: Literal["cm", "m", "inch"] = "cm"
    name: str = Field("n", min_length=1, max_length=9)
    code: Annotated[str, StringConstraints(pattern="^x$")] = "x"
    counts: dict[str, int] = Field({}, min_length=1)
    range: tuple[int, int] = (0, 1)
    quiet: bool = False
    folder: Path = Path()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"uniit": 1}, "uniit: there is no field of this name; did you mean 'unit'?"),
        ({"zzz": 1}, "zzz: there is no field of this name"),
        (
            {"parts": [{"kind": "exercise", "weigth_kg": 1}]},
            "parts.0.weigth_kg: there is no field of this name; did you mean 'weight_kg'?",
        ),
        ({"unit": "inches"}, "unit: the value must be 'cm', 'm' or 'inch'; did you mean 'inch'?"),
        ({"unit": "parsec"}, "unit: the value must be 'cm', 'm' or 'inch'"),
        (
            {"parts": [{"kind": "wlak"}]},
            "parts.0: the field 'kind' must be one of 'exercise', 'walk', not 'wlak'; did you mean 'walk'?",
        ),
        ({"parts": [{}]}, "parts.0: the field 'kind' is missing"),
        ({"parts": [{"kind": "exercise", "weight_kg": 0.5}]}, "parts.0.weight_kg: the value must be above 0.5"),
        ({"parts": [{"kind": "exercise", "weight_kg": 201}]}, "parts.0.weight_kg: the value must be at most 200"),
        ({"parts": [{"kind": "walk", "steps": 0}]}, "parts.0.steps: the value must be at least 1"),
        ({"parts": [{"kind": "walk", "steps": 100}]}, "parts.0.steps: the value must be below 100"),
        ({"parts": [{"kind": "walk"}] * 3}, "parts: the list must have at most 2 entries"),
        ({"parts": {}}, "parts: the value must be a list"),
        ({"parts": [1]}, "parts.0: the value must be an object with named fields"),
        ({"name": ""}, "name: the text must not be empty"),
        ({"name": "n" * 10}, "name: the text must have at most 9 characters"),
        ({"name": 5}, "name: the value must be text"),
        ({"folder": 3}, "folder: the value must be text"),
        ({"code": "y"}, "code: the text must have another form; it may contain a character that is not allowed"),
        ({"counts": {}}, "counts: the object must not be empty"),
        ({"counts": {"a": "many"}}, "counts.a: the value must be a whole number"),
        ({"range": [1]}, "range: the list has too few entries"),
        ({"range": [1, 2.5]}, "range.1: the value must be a whole number"),
        ({"quiet": "perhaps"}, "quiet: the value must be true or false"),
        ([], "the value must be an object with named fields"),
    ],
)
def test_a_fault_is_explained_with_its_place_in_plain_words(given: Any, expected: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Session.model_validate(given)
    assert first_reason(refused.value, Session, given) == expected


@pytest.mark.parametrize("weight", [float("nan"), "NaN"])
def test_nan_is_explained_as_not_finite_and_not_by_a_bound(weight: Any) -> None:
    with pytest.raises(ValidationError) as refused:
        Exercise.model_validate({"kind": "exercise", "weight_kg": weight})
    assert first_reason(refused.value, Exercise) == "weight_kg: the value must be a finite number"


def test_a_value_that_fits_no_type_of_a_union_gets_the_reasons_of_all() -> None:
    class Found(BaseModel):
        at: int | Literal["end"]

    with pytest.raises(ValidationError) as refused:
        Found.model_validate({"at": []})
    reason = first_reason(refused.value, Found, {"at": []})
    assert reason == "at: the value must be a whole number; or the value must be 'end'"


def test_the_fault_of_an_entry_is_reported_before_a_list_without_valid_entries() -> None:
    given = {"schema": "marey/edit@1", "commands": [{"command": "trim", "start": 5, "stop": 2}]}
    with pytest.raises(ValidationError) as refused:
        EditDocument.model_validate(given)
    reason = first_reason(refused.value, EditDocument, given)
    assert reason == "commands.0: the stop, frame 2, must be after the start, frame 5"


def test_every_pattern_of_a_text_has_an_explanation_in_words() -> None:
    for module in walk_packages(marey_schemas.__path__, "marey_schemas."):
        import_module(module.name)
    models = [one for one in below(BaseModel) if one.__module__.startswith("marey_schemas.") and one.model_fields]
    patterns = {pattern for one in models for pattern in patterns_in(one.model_json_schema())}
    assert len(patterns) > 20
    assert patterns <= FORMS.keys()


def below(one: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for each in one.__subclasses__():
        yield each
        yield from below(each)


def patterns_in(schema: Any) -> Iterator[str]:
    if isinstance(schema, dict):
        if isinstance(schema.get("pattern"), str):
            yield schema["pattern"]
        schema = list(schema.values())
    if isinstance(schema, list):
        for one in schema:
            yield from patterns_in(one)
