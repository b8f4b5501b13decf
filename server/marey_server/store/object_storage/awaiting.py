"""Bytes that a transaction needs to move to or from object storage, and their movement outside of transactions.

No transaction may wait for a network. If a transaction needs to store or read an object, it raises `BytesAwaited`,
which rolls it back. The bytes are moved without a transaction. Then the function of the transaction runs again from
the start, and finds the bytes among those that were moved.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, TypeVarTuple

from marey_schemas.encoding.digests import digest_of_hash
from marey_server import faults
from marey_server.errors import DamagedProblem
from marey_server.store.object_storage.client import ObjectStorage, ObjectStorageProblem, StoredObject

A = TypeVarTuple("A")
T = TypeVar("T")

AT_ONCE = 4
"""Number of objects that are moved at the same time for one call."""
MOST_TRANSFERS = 3
"""Greatest number of times that one call stores a blob; it is stored again if its row is written too late."""


class WantedBytes(NamedTuple):
    """Range of bytes of a blob, from `start` to `stop - 1`; `is_whole` says that these are all of its bytes."""

    digest: str
    start: int
    stop: int
    is_whole: bool


@dataclass
class Carried:
    """Bytes that were moved so far for one call of a function; the function runs again after each move."""

    stored: dict[str, StoredObject] = field(default_factory=dict)
    """Objects that were stored, by the digest of their bytes."""
    pieces: dict[WantedBytes, bytes] = field(default_factory=dict)
    """Bytes that were read, by blob and range."""
    absent: set[StoredObject] = field(default_factory=set)
    """Objects that were to be read, but do not exist."""
    fault: str | None = None
    """Reason why no object can be stored, found by the check `ProbeAwaited`; None if one can, or before the check."""
    probed: bool = False
    looked_again: bool = False
    transfers: Counter[str] = field(default_factory=Counter)
    """Number of times that the bytes of each blob were stored, by digest."""


class BytesAwaited(BaseException):
    """Signal that rolls back a transaction, because bytes must be moved; after `move`, the transaction runs again.

    It is raised, but is no subclass of `Exception`, because handlers of errors in the transaction must not catch it.
    """

    def move(self, carried: Carried) -> None:
        """Move the bytes, and record them in `carried`. Must be called without a transaction."""


class LookAgain(BytesAwaited):
    """Signal that bytes are not where the transaction has looked for them; perhaps another process has moved them."""

    def move(self, carried: Carried) -> None:
        """Record that the transaction is repeated because of `LookAgain`, which is done only once; move nothing."""
        carried.looked_again = True


class ProbeAwaited(BytesAwaited):
    """Signal that the transaction must know whether the bucket accepts objects; the check is made outside of it."""

    def __init__(self, storage: ObjectStorage) -> None:
        super().__init__()
        self._storage = storage

    def move(self, carried: Carried) -> None:
        """Check whether the bucket accepts objects, and record the result."""
        carried.fault, carried.probed = self._storage.fault(), True


class ObjectsToStore(BytesAwaited):
    """Signal that the bytes of blobs must be stored as new objects; `contents` maps digests to pieces of bytes."""

    def __init__(self, storage: ObjectStorage, contents: Mapping[str, Iterable[bytes]], now_us: int) -> None:
        super().__init__()
        self._storage = storage
        self._contents = contents
        self._now_us = now_us

    def move(self, carried: Carried) -> None:
        """Store each blob as an object with a new name.

        Raises `ObjectStorageProblem` if a blob was stored `MOST_TRANSFERS` times already, always too late.
        """
        carried.transfers.update(self._contents.keys())
        if any(carried.transfers[digest] > MOST_TRANSFERS for digest in self._contents):
            raise ObjectStorageProblem(
                "The object storage is too slow: bytes of blobs could not be stored in time. Try again later.",
                headers={"Retry-After": "60"},
            )
        objects = [StoredObject.new(digest, self._now_us) for digest in self._contents]
        faults.point("objects.before_put")
        _in_parallel(self._store, [(one,) for one in objects])
        faults.point("objects.after_put")
        carried.stored.update((one.digest, one) for one in objects)

    def _store(self, one: StoredObject) -> None:
        self._storage.put(one.name, self._contents[one.digest])


class ObjectsToRead(BytesAwaited):
    """Signal that ranges of bytes of objects must be read."""

    def __init__(self, storage: ObjectStorage, wanted: Sequence[tuple[WantedBytes, StoredObject]]) -> None:
        super().__init__()
        self._storage = storage
        self._wanted = wanted

    def move(self, carried: Carried) -> None:
        """Read the ranges; record missing objects as `absent`.

        Raises `DamagedProblem` if all bytes of a blob were read and do not have its digest.
        """
        for (wanted, one), data in zip(self._wanted, _in_parallel(self._read, self._wanted), strict=True):
            if data is None:
                carried.absent.add(one)
            else:
                carried.pieces[wanted] = data

    def _read(self, wanted: WantedBytes, one: StoredObject) -> bytes | None:
        data = self._storage.read(one.name, wanted.start, wanted.stop)
        if data is not None and wanted.is_whole and digest_of_chunks([data])[0] != wanted.digest:
            raise DamagedProblem(
                f"The bytes of the blob {wanted.digest} were changed in the object storage. "
                "Ask the operator to run `marey db fsck`.",
                code="blob-damaged",
            )
        return data


def _in_parallel(function: Callable[[*A], T], arguments: Sequence[tuple[*A]]) -> list[T]:
    if len(arguments) == 1:
        return [function(*arguments[0])]
    with ThreadPoolExecutor(min(AT_ONCE, len(arguments))) as pool:
        return list(pool.map(lambda one: function(*one), arguments))


def digest_of_chunks(chunks: Iterable[bytes]) -> tuple[str, int]:
    """Return the digest of the concatenated chunks, and their total number of bytes."""
    hashed, size_bytes = hashlib.sha256(), 0
    for chunk in chunks:
        hashed.update(chunk)
        size_bytes += len(chunk)
    return digest_of_hash(hashed), size_bytes
