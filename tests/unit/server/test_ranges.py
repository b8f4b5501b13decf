"""Byte ranges."""

import pytest

from marey_server.errors import RangeNotSatisfiableProblem
from marey_server.http.streaming import parse_range

ETAG = '"abc.bytes"'


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-3", (0, 4)),
        ("bytes=4-", (4, 10)),
        ("bytes=-3", (7, 10)),
        ("bytes=5-500", (5, 10)),
        ("bytes=-99", (0, 10)),
    ],
)
def test_a_range_is_cut_to_the_bytes_there_are(header: str, expected: tuple[int, int]) -> None:
    wanted = parse_range(header, None, ETAG)
    assert wanted is not None
    assert wanted.within(10) == expected


@pytest.mark.parametrize("header", [None, "bytes=", "bytes=-", "bytes=3-1", "bytes=0-1,3-4", "frames=0-1", "bytes=a-b"])
def test_what_is_no_single_range_is_answered_with_the_whole(header: str | None) -> None:
    assert parse_range(header, None, ETAG) is None


def test_a_range_of_another_state_is_answered_with_the_whole() -> None:
    assert parse_range("bytes=0-3", '"other.bytes"', ETAG) is None
    assert parse_range("bytes=0-3", ETAG, ETAG) is not None


@pytest.mark.parametrize(("header", "size"), [("bytes=10-", 10), ("bytes=-0", 10), ("bytes=0-", 0)])
def test_a_range_outside_says_how_long_the_whole_is(header: str, size: int) -> None:
    wanted = parse_range(header, None, ETAG)
    assert wanted is not None
    with pytest.raises(RangeNotSatisfiableProblem) as refusal:
        wanted.within(size)
    assert refusal.value.headers["Content-Range"] == f"bytes */{size}"
