"""Storage, in the database, of the chunks that make up trees of dataset entries.

The database has chunks in compressed form, so that a commit writes little. Databases of earlier versions also have
chunks that are not compressed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import zstandard
from sqlalchemy import bindparam, select

from marey_server.store import blobs
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.tables import tree_chunk
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.tree.chunks import MOST_CHUNK_BYTES

_CHUNKS = Prepared(
    select(tree_chunk.c.digest, tree_chunk.c.data).where(tree_chunk.c.digest.in_(bindparam("digests", expanding=True)))
)
_START_OF_FRAME = zstandard.FRAME_HEADER
"""First bytes of compressed data; an uncompressed chunk begins with `{` instead."""


class StoredChunks:
    """Chunks in the database. New chunks are collected in `new`; `store_chunks` stores them."""

    def __init__(self, tx: Transaction) -> None:
        self._tx = tx
        self.new: dict[str, bytes] = {}

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        """Return the bytes of chunks; chunks that do not exist are left out."""
        wanted = list(digests)
        found = {digest: self.new[digest] for digest in wanted if digest in self.new}
        missing = [digest for digest in wanted if digest not in found]
        decompressor = zstandard.ZstdDecompressor()
        for some in in_lists(missing):
            rows = self._tx.run(_CHUNKS, {"digests": padded(some)})
            found.update((row.digest, chunk_in(row.data, decompressor)) for row in rows)
        return found

    def save(self, chunks: Mapping[str, bytes]) -> None:
        """Add new chunks to `new`, by digest; they are not written to the database yet."""
        self.new.update(chunks)


def store_chunks(tx: Transaction, chunks: Mapping[str, bytes]) -> None:
    """Store chunks by digest. If a chunk is stored already, only its time is renewed, so that no purge deletes it."""
    compressor = zstandard.ZstdCompressor(level=1)
    rows = [
        {
            "digest": digest,
            "data": compressor.compress(data) if len(data) <= MOST_CHUNK_BYTES else data,
            "created_us": tx.now_us,
        }
        for digest, data in chunks.items()
    ]
    blobs.insert_new(tx, tree_chunk, rows)


def chunk_in(stored: bytes, decompressor: zstandard.ZstdDecompressor | None = None) -> bytes:
    """Return the bytes of a chunk from the value of `tree_chunk.data`.

    Callers that read many chunks pass one `decompressor`, because making a decompressor takes longer than using it. A
    damaged value is returned unchanged; `decode` then refuses it, because it does not have the digest of the chunk.
    """
    data = bytes(stored)
    if not data.startswith(_START_OF_FRAME):
        return data
    try:
        if zstandard.frame_content_size(data) > MOST_CHUNK_BYTES:
            return data
        return (decompressor or zstandard.ZstdDecompressor()).decompress(data, max_output_size=MOST_CHUNK_BYTES)
    except zstandard.ZstdError:
        return data
