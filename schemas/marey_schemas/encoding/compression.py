"""Compression of bodies and answers with zstd, the content coding of RFC 8878."""

from __future__ import annotations

import zstandard

ZSTD = "zstd"
"""Name of the content coding in HTTP headers."""
LEAST_BYTES_COMPRESSED = 1024
"""Size in bytes below which bodies and answers are sent as they are."""
LEVEL = 3


class CompressionError(ValueError):
    """Bytes are not one complete zstd frame that states the size of its content."""


def compress(data: bytes) -> bytes:
    """Return one zstd frame that states the size of its content."""
    return zstandard.ZstdCompressor(level=LEVEL).compress(data)


def content_size(frame: bytes) -> int:
    """Return the size in bytes that a zstd frame states for its content, which nothing has checked yet.

    Raises `CompressionError` if the bytes are no zstd frame, or if the frame states no size.
    """
    try:
        size = zstandard.frame_content_size(frame)
    except zstandard.ZstdError as error:
        raise CompressionError("the data does not begin with a zstd frame") from error
    if size < 0:
        raise CompressionError("the zstd frame does not state the size of its content")
    return size


def decompress(frame: bytes) -> bytes:
    """Return the content of a zstd frame; this takes as much memory as the frame states (see `content_size`).

    Raises `CompressionError` if the bytes are not one complete zstd frame that states the size of its content.
    """
    size = content_size(frame)
    try:
        content = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CompressionError(f"the zstd frame is damaged: {error}") from error
    if len(content) != size:
        raise CompressionError(f"the zstd frame has {len(content)} bytes of content, but states {size}")
    return content
