"""Inputs kept on disk."""

import os
import threading

import pytest

from marey_worker.cache import InputCache


class Source:
    """Bytes by key, and how often they were fetched."""

    def __init__(self):
        self.fetched = []

    def of(self, key, size=100):
        def fetch():
            self.fetched.append(key)
            return key.encode() * size

        return fetch


@pytest.fixture
def source():
    return Source()


def test_what_was_fetched_once_is_not_fetched_again(tmp_path, source):
    for _ in range(2):
        for cache in (InputCache(tmp_path, 1 << 20), InputCache(tmp_path, 1 << 20)):
            assert cache.get("a", source.of("a")) == b"a" * 100
    assert source.fetched == ["a"]


@pytest.mark.parametrize("damage", [b"", b"short", b"x" * 132])
def test_a_damaged_file_is_fetched_again(tmp_path, source, damage):
    cache = InputCache(tmp_path, 1 << 20)
    cache.get("a", source.of("a"))
    (file,) = tmp_path.iterdir()
    file.write_bytes(damage)
    assert cache.get("a", source.of("a")) == b"a" * 100
    assert cache.get("a", source.of("a")) == b"a" * 100
    assert source.fetched == ["a", "a"]


def test_the_folder_stays_below_its_limit_and_loses_what_was_not_used_for_longest(tmp_path, source):
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


def test_what_is_larger_than_the_whole_cache_passes_through(tmp_path, source):
    cache = InputCache(tmp_path, 1000)
    assert len(cache.get("a", source.of("a", 5000))) == 5000
    assert list(tmp_path.iterdir()) == []


def test_a_failed_fetch_leaves_nothing(tmp_path):
    cache = InputCache(tmp_path, 1000)

    def fail():
        raise ConnectionError

    with pytest.raises(ConnectionError):
        cache.get("a", fail)
    assert list(tmp_path.iterdir()) == []


def test_many_threads_may_ask_for_the_same(tmp_path, source):
    cache = InputCache(tmp_path, 1 << 20)
    wrong = []

    def ask():
        wrong.extend(key for key in "abcdefgh" if cache.get(key, source.of(key)) != key.encode() * 100)

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".new-")]
