"""Streaming of a blob or of one byte range (RFC 9110, section 14); a request for several ranges gets the whole blob."""

from __future__ import annotations

import asyncio
import base64
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from urllib.parse import quote

from marey_server.errors import DamagedProblem, RangeNotSatisfiableProblem
from marey_server.http.caching import IMMUTABLE, NOT_STORED
from marey_server.http.etags import entity_tag, matches
from marey_server.http.exchange import JOINED_BYTES, PIECE_BYTES
from marey_server.http.reply import Rendered
from marey_server.http.resource import Resource
from marey_server.store import blobs
from marey_server.store.transaction import Transaction

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
SIGNED_FOR_S = 60
"""Seconds for which anybody who has a signed URL can read the blob; a download that has begun may take longer."""
_REDIRECTED = {"Cache-Control": NOT_STORED, "Vary": "*"}
"""Headers of an answer that redirects an authorized client to object storage."""
HELD_BYTES = 2 * PIECE_BYTES
"""Memory that a long blob needs while it is sent: one piece is being sent, and the next one is being read."""


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Range of bytes from `first` to `last`, both included.

    If `last` is None, the range ends with the last byte of the content. If `first` is None, the range consists of the
    final `last` bytes of the content.
    """

    first: int | None
    last: int | None

    def within(self, size: int) -> tuple[int, int]:
        """Return the offsets of the first byte and of the byte after the last one, in content of `size` bytes.

        Raises `RangeNotSatisfiableProblem` if no byte of the content is in the range.
        """
        if self.first is None:
            start, stop = max(size - (self.last or 0), 0), size
        else:
            start, stop = self.first, size if self.last is None else min(self.last + 1, size)
        if start >= stop:
            headers = {"Content-Range": f"bytes */{size}"}
            raise RangeNotSatisfiableProblem(
                f"The requested range is outside the resource, which has {size} bytes.", headers=headers
            )
        return start, stop


def parse_range(header: str | None, if_range: str | None, etag: str) -> ByteRange | None:
    """Return the byte range that the Range header requests, or None if the whole blob is to be sent.

    The whole blob is also sent if the header is malformed or requests several ranges, or if If-Range is not `etag`.
    """
    if header is None or (if_range is not None and if_range.strip() != etag):
        return None
    match = _RANGE.fullmatch(header.strip())
    if match is None or not (match[1] or match[2]):
        return None
    first = int(match[1]) if match[1] else None
    last = int(match[2]) if match[2] else None
    if first is not None and last is not None and last < first:
        return None
    return ByteRange(first, last)


@dataclass(frozen=True, slots=True)
class _Opened:
    """Blob about to be sent: its size, the requested range, and the first piece.

    `stored_as` is the name of an object if the client is to read the bytes from object storage; then there is no first
    piece.
    """

    size: int
    start: int
    stop: int
    first: bytes = b""
    stored_as: str | None = None


def _open_blob(
    tx: Transaction, digest: str, wanted: ByteRange | None, *, head: bool, redirect_bytes: int | None
) -> _Opened:
    """Find the requested range of a blob, and read the first piece of the range.

    No piece is read if only the headers are requested (`head`), or if the blob is in object storage and has at least
    `redirect_bytes` bytes. Raises `NotFoundProblem` if the caller may not read the blob, and
    `RangeNotSatisfiableProblem` if no byte of the blob is in the range.
    """
    size = blobs.require_readable(tx, digest)
    start, stop = wanted.within(size) if wanted is not None else (0, size)
    if head:
        return _Opened(size, start, stop)
    if redirect_bytes is not None and size >= redirect_bytes and (stored := blobs.object_of(tx, digest)):
        return _Opened(size, start, stop, stored_as=stored.name)
    return _Opened(size, start, stop, blobs.read_blob(tx, digest, start, min(stop, start + PIECE_BYTES)))


def attachment(file_name: str) -> str:
    """Return the value of the header Content-Disposition (RFC 6266) for a file name with any characters."""
    plain = "".join(sign if " " <= sign <= "~" and sign not in '"\\%' else "_" for sign in file_name)
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(file_name, safe='')}"


class BlobSender(Resource):
    """Base of resources that answer with the bytes of a blob."""

    async def send_blob(
        self,
        digest: str,
        *,
        disposition: str = "attachment",
        media_type: str = "application/octet-stream",
        cache_control: str = IMMUTABLE,
        headers: Mapping[str, str] = MappingProxyType({}),
        may_redirect: bool = False,
    ) -> Rendered | None:
        """Answer with the blob according to the headers Range, If-Range and If-None-Match.

        By default, clients may cache the blob for a year; pass another `cache_control` if the URL does not contain the
        digest. `headers` are sent with the bytes. With `may_redirect`, the answer for a large blob may refer to object
        storage, which sends other headers. Raises `NotFoundProblem` if the caller may not read the blob.
        """
        etag = entity_tag(digest.removeprefix("sha256:"), "bytes")
        wanted = parse_range(self.request.headers.get("Range"), self.request.headers.get("If-Range"), etag)
        opened = await self.look_up(
            _open_blob,
            digest,
            wanted,
            head=self.request.method == "HEAD",
            redirect_bytes=self.services.settings.s3_redirect_bytes if may_redirect else None,
        )
        fields = {
            "ETag": etag,
            "Cache-Control": cache_control,
            "Repr-Digest": f"sha-256=:{base64.b64encode(bytes.fromhex(digest[7:])).decode()}:",
            "Accept-Ranges": "bytes",
            "Vary": "Accept, Accept-Encoding, Authorization",
        }
        if matches(self.request.headers.get("If-None-Match"), etag):
            return Rendered(304, fields, b"")
        if opened.stored_as is not None:
            url = self.services.database.submit_signed_url(opened.stored_as, SIGNED_FOR_S)
            return Rendered(307, {"Location": await asyncio.wrap_future(url), **_REDIRECTED}, b"")
        if wanted is not None:
            fields["Content-Range"] = f"bytes {opened.start}-{opened.stop - 1}/{opened.size}"
        fields |= {"Content-Type": media_type, "Content-Disposition": disposition, **headers}
        whole_bytes = opened.stop - opened.start
        sends_pieces = whole_bytes > JOINED_BYTES and self.request.method != "HEAD"
        if sends_pieces:
            self.holding.grow(min(whole_bytes, HELD_BYTES))  # before the first byte, because it may refuse the request
        self.send(Rendered(200 if wanted is None else 206, fields, opened.first), whole_bytes=whole_bytes)
        position, stop = opened.start + len(opened.first), opened.stop
        del opened  # otherwise the first piece would stay in memory until a slow client has received the last one
        if sends_pieces:
            await self._send_rest(digest, position, stop)
        return None

    async def _send_rest(self, digest: str, position: int, end: int) -> None:
        """Send the pieces after the first one, one at a time, and wait until all are sent."""
        while position < end:
            await self.flush()
            stop = min(end, position + PIECE_BYTES)
            piece = await self.look_up(blobs.read_range, digest, position, stop)
            if len(piece) != stop - position:
                raise DamagedProblem(f"Bytes of the blob {digest} are missing on the server.", code="blob-damaged")
            self.write(piece)
            position = stop
        await self.flush()
