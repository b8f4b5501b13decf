"""What a warm process keeps."""

from marey_worker.kept import Kept


def test_what_was_used_last_is_not_made_again() -> None:
    kept: Kept[str, str] = Kept(2)
    made = []

    def make(key: str) -> str:
        made.append(key)
        return key.upper()

    for key in "abacab":
        assert kept.get(key, lambda key=key: make(key)) == key.upper()  # type: ignore[misc]
    assert made == ["a", "b", "c", "b"]


def test_room_is_made_before_the_next_is_made() -> None:
    kept: Kept[str, list[str]] = Kept(1)
    alive: list[str] = []

    class Large(list[str]):
        def __init__(self) -> None:
            alive.append("+")

        def __del__(self) -> None:
            alive.append("-")

    kept.get("a", Large)
    kept.get("b", Large)
    assert alive == ["+", "-", "+"]
