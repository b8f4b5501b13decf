"""Streaming reader of `multipart/form-data` (RFC 7578), so that files need not fit into memory."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header

from marey_schemas.sizes import KIB
from marey_server.errors import BadRequestProblem, TooLargeProblem, UnsupportedMediaTypeProblem

FORM = "multipart/form-data"
"""Media type of a body with files and form fields."""
MAX_HEAD_BYTES = 16 * KIB
MAX_BOUNDARY_BYTES = 70
"""Greatest length of a boundary (RFC 2046, section 5.1.1)."""


@dataclass(frozen=True, slots=True)
class PartHead:
    """Headers of a part: the name of the form field, and the file name if the part is a file."""

    field: str
    file_name: str | None


@dataclass(frozen=True, slots=True)
class PartEnd:
    """Event that marks the end of a part."""


Piece = PartHead | bytes | PartEnd


def boundary_of(content_type: str) -> bytes:
    """Return the boundary of a Content-Type header.

    Raises `UnsupportedMediaTypeProblem` for another media type, and `BadRequestProblem` if the boundary is missing or
    too long.
    """
    media_type, parameters = parse_options_header(content_type)
    if media_type != FORM.encode():
        raise UnsupportedMediaTypeProblem(
            f"Files must be sent with the Content-Type {FORM}; this request has {content_type or 'none'}."
        )
    boundary = parameters.get(b"boundary", b"")
    if not 0 < len(boundary) <= MAX_BOUNDARY_BYTES:
        raise BadRequestProblem(
            f"The Content-Type {FORM} needs a boundary of 1 to {MAX_BOUNDARY_BYTES} bytes.",
            code="bad-multipart",
        )
    return boundary


class MultipartReader:
    """Reader that splits a stream into parts: one `PartHead`, pieces of bytes and one `PartEnd` for each part.

    The package `python-multipart` parses the stream; this class limits the size of heads and the number of parts, and
    skips a preamble.
    """

    def __init__(self, boundary: bytes, *, max_parts: int) -> None:
        self._first_delimiter = b"\r\n--" + boundary
        self._preamble: bytes | None = b"\r\n"  # None once the first delimiter was found
        self._most_parts = self._parts_left = max_parts
        self._pieces: list[Piece] = []
        self._head_bytes = 0
        self._name, self._value = bytearray(), bytearray()
        self._disposition: bytes | None = None
        self._ended = False
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin_part,
                "on_header_field": self._add_header_name,
                "on_header_value": self._add_header_value,
                "on_header_end": self._end_header,
                "on_headers_finished": self._end_head,
                "on_part_data": lambda data, start, stop: self._pieces.append(data[start:stop]),
                "on_part_end": lambda: self._pieces.append(PartEnd()),
                "on_end": self._end,
            },
            max_header_count=MAX_HEAD_BYTES,
            max_header_size=sys.maxsize,  # `_count_head` bounds the whole head
        )

    def feed(self, data: bytes) -> list[Piece]:
        """Parse the next bytes; return the heads, pieces and ends of parts that were found in them.

        Raises `BadRequestProblem` if the body is malformed, and `TooLargeProblem` for too many parts or a too long
        head.
        """
        if self._preamble is not None:
            data = self._skip_preamble(self._preamble + data)
        try:
            self._parser.write(data)
        except MultipartParseError as error:
            raise BadRequestProblem(f"The multipart body is malformed: {error}.", code="bad-multipart") from error
        pieces, self._pieces = self._pieces, []
        return pieces

    def finish(self) -> None:
        """Raise `BadRequestProblem` unless the stream ended with the closing boundary."""
        if not self._ended:
            raise BadRequestProblem("The multipart body ends before its closing boundary.", code="bad-multipart")

    def _skip_preamble(self, data: bytes) -> bytes:
        at = data.find(self._first_delimiter)
        if at < 0:
            self._preamble = data[1 - len(self._first_delimiter) :]
            return b""
        self._preamble = None
        return data[at + len(b"\r\n") :]

    def _begin_part(self) -> None:
        if self._parts_left == 0:
            raise TooLargeProblem(
                f"The multipart body has more than {self._most_parts:,} parts; send fewer files in each request.",
                code="too-many-parts",
            )
        self._parts_left -= 1
        self._head_bytes = 0
        self._disposition = None

    def _add_header_name(self, data: bytes, start: int, stop: int) -> None:
        self._count_head(stop - start)
        self._name += data[start:stop]

    def _add_header_value(self, data: bytes, start: int, stop: int) -> None:
        self._count_head(stop - start)
        self._value += data[start:stop]

    def _count_head(self, more_bytes: int) -> None:
        self._head_bytes += more_bytes
        if self._head_bytes > MAX_HEAD_BYTES:
            raise TooLargeProblem(
                f"The header lines of a part of the multipart body are longer than {MAX_HEAD_BYTES} bytes."
            )

    def _end_header(self) -> None:
        if self._name.strip().lower() == b"content-disposition" and self._disposition is None:
            self._disposition = bytes(self._value)
        self._name.clear()
        self._value.clear()

    def _end_head(self) -> None:
        disposition, parameters = parse_options_header(self._disposition)
        if disposition != b"form-data" or b"name" not in parameters:
            raise BadRequestProblem(
                "A part of the multipart body has no header Content-Disposition: form-data with a name.",
                code="bad-multipart",
            )
        file_name = parameters.get(b"filename")
        self._pieces.append(PartHead(_text(parameters[b"name"]), None if file_name is None else _text(file_name)))

    def _end(self) -> None:
        self._ended = True


def _text(value: bytes) -> str:
    """Decode the name of a field or file; browsers write quotation marks and line ends as `%22`, `%0D` and `%0A`."""
    try:
        text = value.decode("utf-8")
    except UnicodeDecodeError:
        raise BadRequestProblem(
            "The header lines of a part of the multipart body are not UTF-8.", code="bad-multipart"
        ) from None
    return text.replace("%22", '"').replace("%0D", "\r").replace("%0A", "\n")
