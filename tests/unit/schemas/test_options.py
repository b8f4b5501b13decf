"""Options: each is declared once, with a default, a description, and its unit in words."""

import importlib
import pkgutil
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

import marey_schemas.options as room
from marey_schemas.base import Options
from marey_schemas.options.annotations import StepsProposal, VelocityMinimaProposal, WristContactProposal
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_kinds import BUILT_IN
from marey_schemas.queue.job_params import AnnotateParams
from marey_schemas.queue.kind_declaration import KindDeclaration

UNITS = {
    "_m_s": "metres per second", "_deg_s": "degrees per second", "_s": "second", "_hz": "hertz", "_cm": "centimetre",
    "_m": "metre",
}  # fmt: skip


def declared() -> list[type[Options]]:
    """Return every class of options that the package declares."""
    modules = [importlib.import_module(f"{room.__name__}.{one.name}") for one in pkgutil.iter_modules(room.__path__)]
    found = {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Options) and value.model_fields
    }
    return sorted(found, key=lambda one: one.__name__)


@pytest.mark.parametrize("options", declared(), ids=lambda one: one.__name__)
def test_every_option_has_a_default_and_a_description_with_its_unit(options: type[Options]) -> None:
    for name, field in options.model_fields.items():
        assert not field.is_required(), name
        assert field.description, name
        unit = next((ending for ending in UNITS if name.endswith(ending)), None)
        assert unit is None or UNITS[unit] in field.description.lower(), name


@pytest.mark.parametrize("options", declared(), ids=lambda one: one.__name__)
def test_options_are_frozen_and_misspelt_ones_are_refused(options: type[Options]) -> None:
    with pytest.raises(ValidationError, match="frozen"):
        setattr(options(), next(iter(options.model_fields)), None)
    with pytest.raises(ValidationError, match="no_such_option"):
        options.model_validate({"no_such_option": 1})


@pytest.mark.parametrize("kind", BUILT_IN, ids=lambda one: one.name)
def test_parameters_of_a_job_repeat_no_option_that_they_extend(kind: KindDeclaration) -> None:
    for model in kind.params.__mro__:
        own = vars(model).get("__annotations__", {}).keys()
        for base in model.__mro__[1:]:
            if issubclass(base, BaseModel):
                assert not own & base.model_fields.keys(), f"{model.__name__} declares fields of {base.__name__} again"


@pytest.mark.parametrize("kind", BUILT_IN, ids=lambda one: one.name)
def test_every_parameter_of_a_job_has_a_description(kind: KindDeclaration) -> None:
    assert [name for name, field in kind.params.model_fields.items() if not field.description] == []


@pytest.mark.parametrize(
    "proposal", [StepsProposal(), VelocityMinimaProposal(joints=("Head",)), WristContactProposal()]
)
def test_a_proposal_that_was_made_in_python_is_understood_by_the_server(proposal: Any) -> None:
    params = AnnotateParams(proposal=proposal)
    assert AnnotateParams.model_validate(params.model_dump(mode="json", exclude_unset=True)) == params


@pytest.mark.parametrize("path", [".", "..", "../raw", "raw/./day1", "raw/.."])
def test_imports_refuse_relative_folders_but_not_names_with_dots(path: str) -> None:
    with pytest.raises(ValidationError, match=r"must not contain \. or \.\."):
        ImportOptions(collection=path)
    assert ImportOptions(collection="raw/.day1/take..2").collection == "raw/.day1/take..2"
