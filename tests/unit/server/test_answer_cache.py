"""What the cache of answers keeps, and what it lets go."""

from marey_server.http.answer_cache import ENTRY_BYTES, LARGEST_SHARE, AnswerCache

BODY = bytes(1000)
PLACES = 8


class Bodies:
    """Makes bodies and counts how often."""

    def __init__(self, size: int = len(BODY)) -> None:
        self.made: list[str] = []
        self.cache = AnswerCache(PLACES * (len(BODY) + ENTRY_BYTES))
        self.size = size

    def ask(self, digest: str, form: str = "json") -> bytes:
        def make() -> bytes:
            self.made.append(f"{digest}.{form}")
            return bytes(self.size)

        return self.cache.get((digest, form), make)


def test_a_body_is_made_once_for_each_form() -> None:
    bodies = Bodies()
    for _ in range(3):
        assert bodies.ask("a") == bodies.ask("a", "msgpack") == BODY
    assert bodies.made == ["a.json", "a.msgpack"]


def test_what_was_not_asked_for_the_longest_time_goes_first() -> None:
    bodies = Bodies()
    for digest in "abcdefgh":
        bodies.ask(digest)
    bodies.ask("a")
    bodies.ask("new")
    bodies.made.clear()
    for digest in ("a", "new", "c", "b"):
        bodies.ask(digest)
    assert bodies.made == ["b.json"]


def test_a_body_that_would_push_out_much_is_not_kept() -> None:
    bodies = Bodies(size=PLACES * (len(BODY) + ENTRY_BYTES) // LARGEST_SHARE)
    bodies.ask("large")
    bodies.ask("large")
    assert bodies.made == ["large.json"] * 2


def test_a_cache_without_room_keeps_nothing() -> None:
    bodies = Bodies()
    bodies.cache = AnswerCache(0)
    bodies.ask("a")
    bodies.ask("a")
    assert bodies.made == ["a.json"] * 2
