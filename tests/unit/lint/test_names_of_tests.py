"""Names of tests are short, however long the values of their parameters are."""

import pytest
from tests.support.names_of_tests import LONGEST, pytest_make_parametrize_id


def test_a_long_text_is_named_by_its_parameter_and_length() -> None:
    assert pytest_make_parametrize_id("x" * (LONGEST + 1), "line") == "line of 201 characters"
    assert pytest_make_parametrize_id(b"x" * 5000, "data") == "data of 5000 bytes"
    assert pytest_make_parametrize_id("x" * LONGEST, "line") is None
    assert pytest_make_parametrize_id(10**300, "number") is None


@pytest.mark.parametrize("data", [b"\0" * 1_000_000])
def test_every_test_of_this_run_has_a_short_name(request: pytest.FixtureRequest, data: bytes) -> None:
    assert max(len(item.nodeid) for item in request.session.items) < 2000
