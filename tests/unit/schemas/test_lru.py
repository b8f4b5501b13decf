"""Cache of recently used values: values that stay, and values that are removed first."""

import threading

from marey_schemas.lru import LruCache


class Counting:
    """Requests values from a cache, and records the keys for which values had to be computed."""

    def __init__(self, cache: LruCache[str, bytes], size: int = 100) -> None:
        self.cache = cache
        self.size = size
        self.made: list[str] = []

    def ask(self, keys: str) -> None:
        for key in keys:
            assert self.cache.get_or_make(key, lambda key=key: self._make(key)) == key.encode() * self.size

    def _make(self, key: str) -> bytes:
        self.made.append(key)
        return key.encode() * self.size


def test_a_value_is_made_once_while_it_is_used() -> None:
    values = Counting(LruCache(max_entries=2))
    values.ask("abacab")
    assert values.made == ["a", "b", "c", "b"]


def test_the_least_recently_used_values_go_when_the_bytes_do_not_fit() -> None:
    values = Counting(LruCache(max_bytes=300, size_of=len))
    values.ask("abc")
    values.ask("a")
    values.ask("d")
    assert [values.cache.get(key) is not None for key in "abcd"] == [True, False, True, True]


def test_a_value_over_the_largest_size_displaces_nothing() -> None:
    values = Counting(LruCache(max_bytes=800, largest_bytes=100, size_of=len))
    values.ask("ab")
    values.size = 101
    values.ask("cc")
    assert values.made == ["a", "b", "c", "c"]
    assert len(values.cache) == 2


def test_a_cache_without_room_keeps_nothing() -> None:
    values = Counting(LruCache(max_bytes=0, largest_bytes=0, size_of=len))
    values.ask("aa")
    assert values.made == ["a", "a"]


def test_the_newest_value_is_kept_even_if_it_alone_is_over_the_bytes() -> None:
    values = Counting(LruCache(max_bytes=50, size_of=len))
    values.ask("abb")
    assert values.made == ["a", "b"]
    assert values.cache.get("a") is None


def test_a_value_that_is_replaced_no_longer_counts() -> None:
    cache: LruCache[str, bytes] = LruCache(max_bytes=300, size_of=len)
    for _ in range(5):
        cache.put("a", bytes(200))
    cache.put("b", bytes(100))
    assert len(cache) == 2


def test_room_is_freed_before_the_next_value_is_made() -> None:
    cache: LruCache[str, Large] = LruCache(max_entries=1)
    alive: list[str] = []
    cache.get_or_make("a", lambda: Large(alive))
    cache.get_or_make("b", lambda: Large(alive))
    assert alive == ["+", "-", "+"]


class Large:
    """Value that records when it is created and when it is freed."""

    def __init__(self, alive: list[str]) -> None:
        self.alive = alive
        alive.append("+")

    def __del__(self) -> None:
        self.alive.append("-")


def test_threads_share_a_cache_within_its_bounds() -> None:
    cache: LruCache[int, bytes] = LruCache(max_entries=8, max_bytes=500, size_of=len)

    def use(seed: int) -> None:
        for step in range(2000):
            key = (seed * 7 + step * 13) % 31
            assert cache.get_or_make(key, lambda key=key: bytes([key]) * 100) == bytes([key]) * 100

    threads = [threading.Thread(target=use, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    held = [key for key in range(31) if cache.get(key) is not None]
    assert len(held) == len(cache) == 5
