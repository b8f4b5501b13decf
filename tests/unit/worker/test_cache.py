"""Cache of inputs on disk."""

import os
import resource
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from marey_worker.job_io.input_cache import InputCache


class Source:
    """Source of bytes by key, which counts how often they are fetched."""

    def __init__(self) -> None:
        self.fetched: list[str] = []

    def of(self, key: str, size: int = 100) -> Callable[[], bytes]:
        def fetch() -> bytes:
            self.fetched.append(key)
            return key.encode() * size

        return fetch


@pytest.fixture
def source() -> Source:
    return Source()


def test_what_was_fetched_once_is_not_fetched_again(tmp_path: Path, source: Source) -> None:
    for _ in range(2):
        for cache in (InputCache(tmp_path, 1 << 20), InputCache(tmp_path, 1 << 20)):
            assert cache.get("a", source.of("a")) == b"a" * 100
    assert source.fetched == ["a"]


@pytest.mark.parametrize("damage", [b"", b"short", b"x" * 132])
def test_a_damaged_file_is_fetched_again(tmp_path: Path, source: Source, damage: bytes) -> None:
    cache = InputCache(tmp_path, 1 << 20)
    cache.get("a", source.of("a"))
    (file,) = tmp_path.iterdir()
    file.write_bytes(damage)
    assert cache.get("a", source.of("a")) == b"a" * 100
    assert cache.get("a", source.of("a")) == b"a" * 100
    assert source.fetched == ["a", "a"]


def test_the_folder_stays_below_its_limit_and_loses_what_was_not_used_for_longest(
    tmp_path: Path, source: Source
) -> None:
    cache = InputCache(tmp_path, 1000)
    for number, key in enumerate("abcd"):
        cache.get(key, source.of(key))
        os.utime(max(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns), (number, number))
    cache.get("a", source.of("a"))
    for key in "efgh":
        cache.get(key, source.of(key))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 1000
    source.fetched.clear()
    cache.get("a", source.of("a"))
    cache.get("b", source.of("b"))
    assert source.fetched == ["b"]


def test_what_is_larger_than_the_whole_cache_passes_through(tmp_path: Path, source: Source) -> None:
    cache = InputCache(tmp_path, 1000)
    assert len(cache.get("a", source.of("a", 5000))) == 5000
    assert list(tmp_path.iterdir()) == []


def test_a_failed_fetch_leaves_nothing(tmp_path: Path) -> None:
    cache = InputCache(tmp_path, 1000)

    def fail() -> None:
        raise ConnectionError

    with pytest.raises(ConnectionError):
        cache.get("a", cast(Any, fail))
    assert list(tmp_path.iterdir()) == []


def test_what_another_worker_removes_while_it_is_read_is_fetched_again(
    tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = InputCache(tmp_path, 1000)
    cache.get("a", source.of("a"))
    (file,) = tmp_path.iterdir()
    read_bytes = type(file).read_bytes

    def read_and_lose(path: Path) -> bytes:
        data = read_bytes(path)
        path.unlink()
        return data

    monkeypatch.setattr(type(file), "read_bytes", read_and_lose)
    assert cache.get("a", source.of("a")) == b"a" * 100


def test_an_input_is_handed_on_though_the_folder_has_gone(tmp_path: Path, source: Source) -> None:
    cache = InputCache(tmp_path / "cache", 1000)
    shutil.rmtree(tmp_path / "cache")
    assert cache.get("a", source.of("a")) == b"a" * 100


def test_an_input_is_handed_on_though_there_is_no_room_for_it(tmp_path: Path, source: Source) -> None:
    cache = InputCache(tmp_path, 1000)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, limits[1]))
    try:
        assert cache.get("a", source.of("a")) == b"a" * 100
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_an_input_is_handed_on_though_another_worker_cleans_up_while_it_is_written(
    tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = InputCache(tmp_path, 1000)
    replace = type(tmp_path).replace

    def lose_and_replace(path: Path, target: Path) -> Any:
        path.unlink()
        return replace(path, target)

    monkeypatch.setattr(type(tmp_path), "replace", lose_and_replace)
    assert cache.get("a", source.of("a")) == b"a" * 100


def test_many_threads_may_ask_for_the_same(tmp_path: Path, source: Source) -> None:
    cache = InputCache(tmp_path, 1 << 20)
    wrong: list[Any] = []

    def ask() -> None:
        wrong.extend(key for key in "abcdefgh" if cache.get(key, source.of(key)) != key.encode() * 100)

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".new-")]


def test_several_keys_are_fetched_at_once_without_those_at_hand(tmp_path: Path) -> None:
    cache = InputCache(tmp_path, 1 << 20)
    cache.get("b", lambda: b"B")
    asked = []

    def fetch(missing: list[int]) -> list[Any]:
        asked.append(missing)
        return [{0: b"A", 2: None}[index] for index in missing]

    for _ in range(2):
        assert cache.get_many(["a", "b", "c"], fetch) == [b"A", b"B", None]
    assert asked == [[0, 2], [2]]


def test_what_is_not_fetched_ends_the_answer(tmp_path: Path) -> None:
    cache = InputCache(tmp_path, 1 << 20)
    cache.get("c", lambda: b"C")
    assert cache.get_many(["a", "b", "c"], lambda _missing: [b"A"]) == [b"A"]
