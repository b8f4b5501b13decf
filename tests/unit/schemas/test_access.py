"""Requests about users and access."""

import pytest
from pydantic import ValidationError

from marey_schemas.access import UserCreate


def test_an_error_about_a_password_does_not_contain_it() -> None:
    with pytest.raises(ValidationError) as refused:
        UserCreate.model_validate({"name": "ada", "password": "hunter2"})
    assert "password" in str(refused.value)
    assert "hunter2" not in str(refused.value)
