"""Resources of resumable uploads: they create an upload, receive its pieces, show its state, and store it as a blob.

Long bodies of other requests are also stored piece by piece. Otherwise, one transaction for all bytes of a body would
delay the writes of other requests.
"""

from __future__ import annotations

import asyncio
import time
from itertools import islice

from marey_schemas.items import Upload, UploadCreate
from marey_schemas.sizes import MIB
from marey_server.access.principal import ANONYMOUS
from marey_server.errors import BadRequestProblem, ConflictProblem
from marey_server.http.caching import NOT_STORED
from marey_server.http.declarations import Access, Bytes, RequestBody, reads, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import blobs, uploads
from marey_server.store.blob_backings import Spool

STORED_BYTES = MIB
"""Number of bytes written at a time; an interrupted request loses at most this number."""
LONGEST_PAUSE_S = 0.2
"""Longest time in seconds that a piece waits for the database to process earlier writes.

Without this wait, uploads would delay other writes.
"""
PAUSE_STEP_S = 0.01
LONG_BODY_BYTES = 4 * MIB
"""Size above which a body is stored in pieces before it becomes a blob, each piece in its own transaction."""
CHUNKS_PER_WRITE = 4
"""Number of chunks of a long body that are stored in one transaction."""


async def store_in_pieces(resource: Resource, spool: Spool) -> None:
    """Store a long body as a blob that the caller may use; do nothing if the body is short or stored already."""
    if spool.size_bytes <= LONG_BODY_BYTES:
        return
    if spool.digest in await resource.look_up(blobs.sizes_of, [spool.digest]):
        return
    upload = await resource.change(uploads.create_upload, spool.size_bytes, digest=spool.digest)
    try:
        chunks = spool.chunks()
        while piece := b"".join(await resource.compute(list, islice(chunks, CHUNKS_PER_WRITE))):
            upload = await append_piece(resource, upload.id, upload.offset, piece)
        await finish_upload(resource, upload)
    except BaseException:
        await resource.change(uploads.abandon, upload.id)
        resource.services.upload_hashes.forget(upload.id)
        raise


async def append_piece(resource: Resource, upload_id: str, offset: int, piece: bytes) -> uploads.StoredUpload:
    """Store a piece of an upload, and add it to the hash of the upload; return the state of the upload."""
    await _let_database_catch_up(resource)
    appended = await resource.change(uploads.append, upload_id, offset, piece)
    await resource.compute(resource.services.upload_hashes.add, upload_id, offset, piece)
    return appended


async def _let_database_catch_up(resource: Resource) -> None:
    deadline_s = time.monotonic() + LONGEST_PAUSE_S
    while resource.services.database.is_behind and time.monotonic() < deadline_s:
        await asyncio.sleep(PAUSE_STEP_S)


async def finish_upload(resource: Resource, upload: uploads.StoredUpload) -> uploads.StoredUpload:
    """Hash the bytes that are not hashed yet, store the upload as a blob, and return the state of the upload."""
    hashes = resource.services.upload_hashes
    while (content := await resource.compute(hashes.finish, resource.principal or ANONYMOUS, upload)) is None:
        upload = await resource.look_up(uploads.read_upload, upload.id)
        if not upload.is_received:  # another request has finished it
            return upload
    upload = await resource.change(uploads.finish, upload.id, *content)
    hashes.forget(upload.id)
    return upload


def upload_reply(upload: uploads.StoredUpload) -> Reply:
    """Return the answer that shows the state of an upload, in its body and in its headers."""
    shown = Upload(id=upload.id, length=upload.length, offset=upload.offset, digest=upload.digest)
    headers = {"Upload-Offset": str(upload.offset), "Upload-Length": str(upload.length), "Cache-Control": NOT_STORED}
    return Reply(shown, headers=headers)


class Uploads(Resource):
    """Resumable uploads."""

    path = "/uploads"
    tag = "Blobs"

    @writes(access=Access.SIGNED_IN, body=UploadCreate, answer=Upload, status=201, idempotency="key", attempts=True)
    async def post(self, body: UploadCreate) -> Rendered:
        """Create an upload, whose bytes are then sent in pieces."""

        def created(upload: uploads.StoredUpload) -> Reply:
            reply = upload_reply(upload)
            return Reply(reply.content, location=f"/uploads/{upload.id}", headers=reply.headers)

        return await self.answer_with(created, uploads.create_upload, body.length, digest=body.digest)


class UploadResource(Resource):
    """An upload."""

    path = "/uploads/{upload}"
    tag = "Blobs"

    async def begin(self, upload: str) -> None:
        """Check the header Upload-Offset before the bytes of the piece are received."""
        text = self.request.headers.get("Upload-Offset", "")
        if not text.isascii() or not text.isdigit() or len(text) > 12:
            raise BadRequestProblem(
                "The header Upload-Offset must be the offset of this piece in the file, in bytes.",
                code="bad-offset",
            )
        self.hold_body(STORED_BYTES)
        self.upload_id, self.offset, self.piece = upload, int(text), bytearray()
        await self._append()

    async def receive(self, chunk: bytes) -> None:
        """Receive the next bytes; pieces of `STORED_BYTES` are stored, and kept if the connection breaks."""
        self.piece += chunk
        if len(self.piece) >= STORED_BYTES:
            await self._append()

    async def _append(self) -> None:
        data = bytes(self.piece)
        self.piece.clear()
        try:
            if data:
                moved = await append_piece(self, self.upload_id, self.offset, data)
            else:
                moved = await self.change(uploads.append, self.upload_id, self.offset, data)
        except ConflictProblem as error:
            error.headers["Upload-Offset"] = str(error.context.get("offset", ""))
            raise
        self.offset = moved.offset

    @reads(access=Access.SIGNED_IN, answer=Upload, attempts=True)
    async def get(self, upload: str) -> Rendered:
        """Return the state of an upload."""
        return await self.answer_with(upload_reply, uploads.read_upload, upload)

    @writes(
        access=Access.SIGNED_IN,
        body=RequestBody(Bytes, max_bytes=uploads.MAX_UPLOAD_BYTES, streamed=True, required=False),
        answer=Upload,
        headers=("Upload-Offset",),
        attempts=True,
    )
    async def patch(self, upload: str) -> Reply:
        """Send the next piece. After the last piece, the upload becomes a blob, whose digest is returned.

        If the offset is wrong, the answer is 409 with the right offset in the header Upload-Offset and in `context`.
        """
        if self.piece:
            await self._append()
        found = await self.look_up(uploads.read_upload, upload)
        if found.is_received:
            found = await finish_upload(self, found)
        uploads.require_intact(found)
        return upload_reply(found)

    @writes(access=Access.SIGNED_IN, attempts=True)
    async def delete(self, upload: str) -> Rendered:
        """Cancel an upload."""
        cancelled = await self.answer(uploads.abandon, upload)
        self.services.upload_hashes.forget(upload)
        return cancelled


RESOURCES: tuple[type[Resource], ...] = (Uploads, UploadResource)
