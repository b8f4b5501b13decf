"""Compression of bodies with zstd."""

from __future__ import annotations

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from marey_schemas.encoding.compression import CompressionError, compress, content_size, decompress

TEXT = b"joints " * 1000


@given(st.binary())
def test_what_was_compressed_comes_back(data: bytes) -> None:
    assert content_size(compress(data)) == len(data)
    assert decompress(compress(data)) == data


@pytest.mark.parametrize(
    "wrong",
    [
        b"", TEXT, compress(TEXT)[:6], compress(TEXT)[:-1], compress(TEXT) + b"1", compress(TEXT) * 2,
        zstandard.ZstdCompressor(write_content_size=False).compress(TEXT), b"\x50\x2a\x4d\x18\x04\x00\x00\x00good",
    ],
)  # fmt: skip
def test_other_bytes_are_refused(wrong: bytes) -> None:
    with pytest.raises(CompressionError):
        decompress(wrong)


def test_a_frame_that_states_a_false_size_is_refused() -> None:
    frame = bytearray(compress(TEXT))
    frame[5:7] = (100).to_bytes(2, "little")  # the field with the size of the content
    assert content_size(bytes(frame)) == 256 + 100
    with pytest.raises(CompressionError):
        decompress(bytes(frame))
