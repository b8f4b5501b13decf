"""Bytes by digest: sent once, read in ranges."""

from __future__ import annotations

import asyncio
import base64
import re
from dataclasses import dataclass

from marey_schemas.items import BlobsMissing, BlobsQuery
from marey_server.errors import NotFound, TooLarge, Unavailable
from marey_server.handlers.calls import only_identify
from marey_server.handlers.declarations import MIB, Access, Body, Bytes, reads, writes
from marey_server.handlers.etags import entity_tag, matches
from marey_server.handlers.ranges import ByteRange, parse_range
from marey_server.handlers.receiving import Receiver
from marey_server.handlers.reply import Rendered, Reply
from marey_server.handlers.resource import Resource
from marey_server.store import blobs
from marey_server.store.database import Transaction

MAX_BLOB_BYTES = 256 * MIB
PIECE_BYTES = MIB
WRITE_TIMEOUT_S = 60
_DIGEST = re.compile(r"sha256:[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class _Opened:
    """A blob about to be sent: its size, the part of it that was asked for, and the first piece."""

    size: int
    start: int
    stop: int
    first: bytes


def open_blob(tx: Transaction, digest: str, wanted: ByteRange | None, *, head: bool) -> _Opened:
    """Decide what of a blob is sent, and read its first piece unless only the head is asked for."""
    size = blobs.require_readable(tx, digest)
    start, stop = wanted.within(size) if wanted is not None else (0, size)
    first = b"" if head else blobs.read_blob(tx, digest, start, min(stop, start + PIECE_BYTES))
    return _Opened(size, start, stop, first)


class Blob(Resource):
    """Bytes named by their SHA-256."""

    path = "/blobs/{digest}"
    tag = "Blobs"

    async def begin(self, digest: str) -> None:
        """Look the credential up before the bytes come."""
        if not _DIGEST.fullmatch(digest):
            raise NotFound("Blobs are named sha256: and 64 hexadecimal digits.")
        if self.declared_length() > MAX_BLOB_BYTES:
            raise TooLarge("Send more than 256 MiB as a resumable upload: POST /api/v1/uploads.")
        await self.look_up(only_identify)
        self.receiver = Receiver(self.services)

    async def receive(self, chunk: bytes) -> None:
        """Take the next bytes."""
        await self.receiver.write(chunk)

    @writes(access=Access.SIGNED_IN, body=Body(Bytes, max_bytes=MAX_BLOB_BYTES, streamed=True, required=False))
    async def put(self, digest: str) -> Rendered:
        """Send bytes by their digest.

        They become visible when a document refers to them; bytes that nothing refers to are dropped after a day.
        """
        with await self.receiver.finish() as spool:
            return await self.answer_with(lambda _digest: Reply(), blobs.put_blob, spool, expected=digest)

    @reads(
        access=Access.READER,
        answer=Bytes,
        answer_types=("application/octet-stream",),
        etag=True,
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, digest: str) -> Rendered | None:
        """Bytes by their digest, whole or a range."""
        if not _DIGEST.fullmatch(digest):
            raise NotFound("Blobs are named sha256: and 64 hexadecimal digits.")
        etag = entity_tag(digest.removeprefix("sha256:"), "bytes")
        wanted = parse_range(self.request.headers.get("Range"), self.request.headers.get("If-Range"), etag)
        opened = await self.look_up(open_blob, digest, wanted, head=self.request.method == "HEAD")
        headers = {
            "ETag": etag,
            "Cache-Control": "private, max-age=31536000, immutable",
            "Repr-Digest": f"sha-256=:{base64.b64encode(bytes.fromhex(digest[7:])).decode()}:",
            "Accept-Ranges": "bytes",
            "Vary": "Accept, Accept-Encoding, Authorization",
        }
        if matches(self.request.headers.get("If-None-Match"), etag):
            return Rendered(304, headers, b"")
        if wanted is not None:
            headers["Content-Range"] = f"bytes {opened.start}-{opened.stop - 1}/{opened.size}"
        headers |= {"Content-Type": "application/octet-stream", "Content-Disposition": "attachment"}
        await self._stream(digest, opened, Rendered(200 if wanted is None else 206, headers, opened.first))
        return None

    async def _stream(self, digest: str, opened: _Opened, first: Rendered) -> None:
        """Send piece after piece, each read only when the one before has gone out."""
        self.send(first)
        self.set_header("Content-Length", str(opened.stop - opened.start))
        if self.request.method == "HEAD":
            return
        position = opened.start + len(first.body)
        while position < opened.stop:
            await asyncio.wait_for(self.flush(), WRITE_TIMEOUT_S)
            stop = min(opened.stop, position + PIECE_BYTES)
            piece = await self.look_up(blobs.read_range, digest, position, stop)
            if len(piece) != stop - position:
                raise Unavailable(f"Bytes of {digest} are lost.", code="blob-damaged")
            self.write(piece)
            position = stop


class MissingBlobs(Resource):
    """Which bytes must be sent."""

    path = "/blobs/missing"
    tag = "Blobs"

    @writes(access=Access.SIGNED_IN, scope="read", body=BlobsQuery, answer=BlobsMissing)
    async def post(self, body: BlobsQuery) -> Reply:
        """Which of these digests the server lacks, as far as you may know."""
        missing = await self.look_up(blobs.missing, body.digests)
        return Reply(BlobsMissing(missing=tuple(missing)))


RESOURCES: tuple[type[Resource], ...] = (Blob, MissingBlobs)
