"""Multipart bodies, cut as they stream."""

import itertools
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_server.errors import BadRequestProblem, TooLargeProblem, UnsupportedMediaTypeProblem
from marey_server.http.multipart import MultipartReader, PartEnd, PartHead, boundary_of

BOUNDARY = b"frontier"


def body_of(parts: list[tuple[bytes, bytes]]) -> bytes:
    lines = []
    for head, data in parts:
        lines += [b"--" + BOUNDARY, head, b"", data]
    return b"\r\n".join([*lines, b"--" + BOUNDARY + b"--", b""])


def head(field: str, file_name: str | None = None) -> bytes:
    text = f'Content-Disposition: form-data; name="{field}"'
    return (text + (f'; filename="{file_name}"' if file_name is not None else "")).encode()


def read(body: bytes, cuts: Sequence[int] = (), max_parts: int = 100) -> list[tuple[PartHead, bytes]]:
    """Return (head, bytes) of every part of a body that the parser gets in pieces, cut at `cuts`."""
    reader = MultipartReader(BOUNDARY, max_parts=max_parts)
    places = [0, *sorted(cuts), len(body)]
    found = []
    for start, stop in itertools.pairwise(places):
        for piece in reader.feed(body[start:stop]):
            if isinstance(piece, PartHead):
                found.append((piece, bytearray()))
            elif isinstance(piece, bytes):
                found[-1][1].extend(piece)
            else:
                assert isinstance(piece, PartEnd)
    reader.finish()
    return [(part, bytes(data)) for part, data in found]


near_boundary = st.lists(
    st.sampled_from([b"\r", b"\n", b"-", b"--", BOUNDARY, b"\r\n--", b"\r\n--fron", b"\x00", b"data"]), max_size=12
).map(b"".join)


@given(
    data=st.lists(near_boundary.filter(lambda data: b"--" + BOUNDARY not in data), max_size=4),
    cuts=st.lists(st.integers(0, 400), max_size=20),
)
def test_parts_come_out_as_they_went_in_wherever_the_stream_is_cut(data: list[bytes], cuts: list[int]) -> None:
    body = body_of([(head("files", f"take{index}.bvh"), one) for index, one in enumerate(data)])
    if not data:
        body = b"--" + BOUNDARY + b"--\r\n"
    found = read(body, [cut for cut in cuts if cut < len(body)])
    assert found == [(PartHead("files", f"take{index}.bvh"), one) for index, one in enumerate(data)]


def test_fields_and_files_are_told_apart() -> None:
    found = read(body_of([(head("collection"), b"raw"), (head("files", "a b.bvh"), b"HIERARCHY")]))
    assert found == [(PartHead("collection", None), b"raw"), (PartHead("files", "a b.bvh"), b"HIERARCHY")]


def test_escaped_quotes_in_file_names_are_read_in_both_spellings() -> None:
    found = read(body_of([(head("files", 'a\\"b.bvh'), b""), (head("files", "a%22b.bvh"), b"")]))
    assert [part.file_name for part, _ in found] == ['a"b.bvh', 'a"b.bvh']


@pytest.mark.parametrize("preamble", [b"preamble\r\n", b"--front\r\n--\r\n", b"\r\n", b"x" * 200_000 + b"\r\n"])
def test_what_comes_before_the_first_part_is_ignored_wherever_the_stream_is_cut(preamble: bytes) -> None:
    body = preamble + body_of([(head("x"), b"1")])
    for cut in range(len(preamble) - 5, len(preamble) + 15):
        assert read(body, [max(cut, 0)]) == [(PartHead("x", None), b"1")]


fragments = st.lists(
    st.one_of(
        st.binary(max_size=20),
        st.sampled_from([
            b"--" + BOUNDARY, b"--" + BOUNDARY + b"--", b"\r\n", b"\r\n\r\n", head("x"), head("f", "a.bvh"),
            b";", b":", b'"',
            b"Content-Disposition: ", b"form-data; name=", b"\xff",
        ]),
    ),
    max_size=30,
).map(b"".join)  # fmt: skip


@given(body=fragments, cuts=st.lists(st.integers(0, 300), max_size=10))
def test_any_bytes_are_read_or_refused_alike_wherever_the_stream_is_cut(body: bytes, cuts: list[int]) -> None:
    def outcome(places: list[int]) -> Any:
        try:
            return read(body, places)
        except (BadRequestProblem, TooLargeProblem) as refused:
            return type(refused)

    assert outcome([cut for cut in cuts if cut < len(body)]) == outcome([])


def test_nothing_of_a_file_is_held_back_but_what_may_be_a_boundary() -> None:
    reader = MultipartReader(BOUNDARY, max_parts=1)
    reader.feed(body_of([(head("files", "a.bvh"), b"")]).partition(b"\r\n\r\n")[0] + b"\r\n\r\n")
    pieces = [piece for _ in range(50) for piece in reader.feed(b"\r\n--front" * 10_000)]
    given_bytes = sum(len(piece) for piece in pieces if isinstance(piece, bytes))
    assert given_bytes >= 50 * 90_000 - len(BOUNDARY) - 4


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"--frontier\r\n",
        body_of([(head("x"), b"1")])[:-10],
        body_of([(b"Content-Type: text/plain", b"1")]),
        body_of([(b"Content-Disposition: attachment", b"1")]),
        b"--frontierland\r\n\r\n--frontier--",
    ],
)
def test_broken_bodies_are_refused(body: bytes) -> None:
    with pytest.raises(BadRequestProblem):
        read(body)


def test_endless_heads_and_too_many_parts_are_refused() -> None:
    with pytest.raises(TooLargeProblem):
        read(b"--frontier\r\nX: " + b"y" * 20_000)
    with pytest.raises(TooLargeProblem):
        read(body_of([(head("x"), b"1")] * 3), max_parts=2)


def test_the_boundary_is_read_with_and_without_quotation_marks() -> None:
    assert boundary_of("multipart/form-data; boundary=abc") == b"abc"
    assert boundary_of('multipart/form-data; charset=utf-8; boundary="a b"') == b"a b"
    with pytest.raises(BadRequestProblem):
        boundary_of("multipart/form-data")
    with pytest.raises(UnsupportedMediaTypeProblem):
        boundary_of("text/plain")
