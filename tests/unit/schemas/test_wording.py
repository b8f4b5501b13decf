import pytest

from marey_schemas.wording import counted


@pytest.mark.parametrize(
    ("number", "expected"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (103_568, "103,568 frames")]
)
def test_a_noun_takes_an_s_unless_there_is_exactly_one(number: int, expected: str) -> None:
    assert counted(number, "frame") == expected


@pytest.mark.parametrize(
    ("noun", "expected"), [("trajectory", "2 trajectories"), ("day", "2 days"), ("index", "2 indexes")]
)
def test_a_noun_in_y_or_x_takes_the_plural_of_its_kind(noun: str, expected: str) -> None:
    assert counted(2, noun) == expected
