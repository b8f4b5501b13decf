"""`multipart/form-data` read as it streams (RFC 7578), so that no file has to fit in memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto

from marey_server.errors import BadRequestProblem, TooLargeProblem, UnsupportedMediaTypeProblem

MAX_HEAD_BYTES = 16 * 1024
_BOUNDARY = re.compile(r'boundary=(?:"([^"]{1,70})"|([^\s;,"]{1,70}))', re.IGNORECASE)
_PARAMETER = re.compile(r';\s*([\w*]+)\s*=\s*(?:"((?:[^"\\]|\\.)*)"|([^;\s]*))')


@dataclass(frozen=True, slots=True)
class PartHead:
    """The head of a part: the form field, and the file name where it is a file."""

    field: str
    file_name: str | None


@dataclass(frozen=True, slots=True)
class PartEnd:
    """The end of a part."""


Piece = PartHead | bytes | PartEnd


class _State(Enum):
    PREAMBLE = auto()
    HEAD = auto()
    BODY = auto()
    EPILOGUE = auto()


def boundary_of(content_type: str) -> bytes:
    """The boundary of a Content-Type header. Raises `UnsupportedMediaTypeProblem` or `BadRequestProblem`."""
    if not content_type.lower().startswith("multipart/form-data"):
        raise UnsupportedMediaTypeProblem(
            f"Files are sent as multipart/form-data, not {content_type or 'without a type'}."
        )
    match = _BOUNDARY.search(content_type)
    if match is None:
        raise BadRequestProblem("The Content-Type names no boundary.", code="bad-multipart")
    return (match[1] or match[2]).encode("latin-1")


class MultipartReader:
    """Cuts a stream into parts: for every part one `PartHead`, its bytes in pieces, one `PartEnd`."""

    def __init__(self, boundary: bytes, *, max_parts: int) -> None:
        self._delimiter = b"\r\n--" + boundary
        self._buffer = bytearray(b"\r\n")  # so that the first delimiter looks like the others
        self._state = _State.PREAMBLE
        self._parts_left = max_parts

    def feed(self, data: bytes) -> Iterator[Piece]:
        """What the next bytes of the stream complete. Raises `BadRequestProblem` or `TooLargeProblem`."""
        self._buffer += data
        while True:
            if self._state is _State.HEAD:
                head = self._take_head()
                if head is None:
                    return
                yield head
            elif self._state is _State.EPILOGUE:
                self._buffer.clear()
                return
            else:
                in_body = self._state is _State.BODY
                before, found = self._take_until_delimiter()
                if before and in_body:
                    yield before
                if not found:
                    return
                if in_body:
                    yield PartEnd()

    def finish(self) -> None:
        """The stream has ended. Raises `BadRequestProblem` where it ended too early."""
        if self._state is not _State.EPILOGUE:
            raise BadRequestProblem("The multipart body ends before its closing boundary.", code="bad-multipart")

    def _take_until_delimiter(self) -> tuple[bytes, bool]:
        """Bytes before the next delimiter, and whether it was found whole; then what follows it is next."""
        at = self._buffer.find(self._delimiter)
        end = at + len(self._delimiter)
        if at < 0 or len(self._buffer) < end + 2:
            keep = len(self._buffer) - at if at >= 0 else min(len(self._buffer), len(self._delimiter) - 1)
            before = bytes(self._buffer[: len(self._buffer) - keep])
            del self._buffer[: len(before)]
            return before, False
        before, after = bytes(self._buffer[:at]), bytes(self._buffer[end : end + 2])
        if after not in (b"\r\n", b"--"):
            raise BadRequestProblem(
                "A boundary of the multipart body is followed by other bytes.", code="bad-multipart"
            )
        del self._buffer[: end + 2]
        self._state = _State.HEAD if after == b"\r\n" else _State.EPILOGUE
        return before, True

    def _take_head(self) -> PartHead | None:
        at = self._buffer.find(b"\r\n\r\n")
        if at > MAX_HEAD_BYTES or (at < 0 and len(self._buffer) > MAX_HEAD_BYTES):
            raise TooLargeProblem(f"The head of a part is longer than {MAX_HEAD_BYTES} bytes.")
        if at < 0:
            return None
        if self._parts_left == 0:
            raise TooLargeProblem("The request has too many parts.", code="too-many-parts")
        self._parts_left -= 1
        head = bytes(self._buffer[:at])
        del self._buffer[: at + 4]
        self._state = _State.BODY
        return _parse_head(head)


def _parse_head(head: bytes) -> PartHead:
    for line in head.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-disposition":
            try:
                text = value.decode("utf-8").strip()
            except UnicodeDecodeError:
                raise BadRequestProblem("The head of a part is not UTF-8.", code="bad-multipart") from None
            found = {key.lower(): _unquoted(quoted) or bare for key, quoted, bare in _PARAMETER.findall(text)}
            if not text.lower().startswith("form-data") or "name" not in found:
                break
            return PartHead(found["name"], found.get("filename"))
    raise BadRequestProblem("A part lacks Content-Disposition: form-data with a name.", code="bad-multipart")


def _unquoted(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text).replace("%22", '"').replace("%0D", "\r").replace("%0A", "\n")
