"""Resources of blobs: bytes named by digest, sent once and read in ranges."""

from __future__ import annotations

from marey_schemas.items import BlobsMissing, BlobsQuery
from marey_schemas.names import is_digest
from marey_schemas.sizes import MIB
from marey_server.errors import NotFoundProblem
from marey_server.handlers.uploads import store_in_pieces
from marey_server.http.declarations import Access, Bytes, RequestBody, reads, writes
from marey_server.http.receiving import BATCH_BYTES, Receiver
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import BlobSender
from marey_server.store import blobs

MAX_BLOB_BYTES = 1024 * MIB
"""Greatest size of a blob in one request; larger blobs need a resumable upload."""


def require_digest(text: str) -> str:
    """Return the text if it is a digest; otherwise raise `NotFoundProblem`."""
    if not is_digest(text):
        raise NotFoundProblem(
            "This is not the digest of a blob; a digest is sha256: followed by 64 hexadecimal digits.", code="no-blob"
        )
    return text


class Blob(BlobSender):
    """Bytes named by their SHA-256."""

    path = "/blobs/{digest}"
    tag = "Blobs"

    async def begin(self, digest: str) -> None:
        """Check that the address contains a valid digest before the bytes are received."""
        require_digest(digest)
        self.hold_body(BATCH_BYTES)
        self.receiver = Receiver(self.services)

    async def receive(self, chunk: bytes) -> None:
        """Store the next bytes."""
        await self.receiver.write(chunk)

    @writes(
        access=Access.SIGNED_IN,
        body=RequestBody(Bytes, max_bytes=MAX_BLOB_BYTES, streamed=True, required=False),
        attempts=True,
    )
    async def put(self, digest: str) -> Rendered:
        """Store bytes under their digest.

        Other users can read the bytes once a document refers to them; bytes to which nothing refers are deleted after a
        day.
        """
        with await self.receiver.finish() as spool:
            if spool.digest == digest:
                await store_in_pieces(self, spool)
            return await self.answer(blobs.put_blob, spool, expected=digest)

    @reads(
        access=Access.READER,
        answer=Bytes,
        answer_types=("application/octet-stream",),
        etag=True,
        also=((206, None), (307, None), (416, None)),
        headers=("Range", "If-Range"),
        attempts=True,
    )
    async def get(self, digest: str) -> Rendered | None:
        """Return the bytes of a blob, or a range of them.

        The answer to a request for a large blob may be 307 with an address at the object storage. Send the same headers
        to this address, but not the token.
        """
        return await self.send_blob(require_digest(digest), may_redirect=True)


class MissingBlobs(Resource):
    """Blobs that the caller must send before documents can refer to them."""

    path = "/blobs/missing"
    tag = "Blobs"

    @writes(access=Access.SIGNED_IN, scope="read", body=BlobsQuery, answer=BlobsMissing)
    async def post(self, body: BlobsQuery) -> Reply:
        """Return those of the given digests whose blobs must be sent before documents can refer to them."""
        missing = await self.look_up(blobs.missing, body.digests)
        return Reply(BlobsMissing(missing=tuple(missing)))


RESOURCES: tuple[type[Resource], ...] = (Blob, MissingBlobs)
