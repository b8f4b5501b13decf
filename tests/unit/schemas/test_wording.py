import pytest

from marey_schemas.wording import counted


@pytest.mark.parametrize(
    ("number", "told"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (103_568, "103,568 frames")]
)
def test_a_noun_takes_an_s_unless_there_is_exactly_one(number: int, told: str) -> None:
    assert counted(number, "frame") == told


@pytest.mark.parametrize(("noun", "told"), [("trajectory", "2 trajectories"), ("day", "2 days")])
def test_a_noun_in_y_takes_the_plural_of_its_kind(noun: str, told: str) -> None:
    assert counted(2, noun) == told
