"""Types of the generated keyword arguments of the SDK."""

from typing import Any

import pytest
from docs.keyword_types import KeywordModule


@pytest.mark.parametrize(
    ("kind", "written"),
    [
        (tuple[int | None, ...] | None, "Sequence[int | None] | None"),
        (tuple[int | str | None, ...] | str, "Sequence[int | str | None] | str"),
        (dict[str, int | str | float] | str | None, "Mapping[str, int | str | float] | str | None"),
        (tuple[str, ...] | str | None, "list[str] | tuple[str, ...] | str | None"),
    ],
)
def test_types_inside_brackets_are_not_those_outside(kind: Any, written: str) -> None:
    assert KeywordModule({})._written(kind) == written
