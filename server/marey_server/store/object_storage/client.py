"""Objects in a bucket of an S3 server: each is written once, under a name that is never used again.

Methods block until the server has answered, and may be called by several threads. No transaction may call them: an S3
server that does not answer would keep the locks of the transaction.
"""

from __future__ import annotations

import logging
import re
import secrets
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from itertools import chain
from typing import TYPE_CHECKING, Self

from marey_schemas.sizes import MIB
from marey_server.errors import UnavailableProblem

if TYPE_CHECKING:
    from obstore.store import S3Config, S3Store

log = logging.getLogger(__name__)

PART_BYTES = 8 * MIB
"""Size of a part of an object; an object of more bytes is sent in several parts.

S3 allows 10,000 parts, which is enough for 78 GiB; an upload has at most 16 GiB.
"""
PARTS_AT_ONCE = 2
CONNECT_TIMEOUT_S = 5.0
RETRIES = 4
FIRST_RETRY_S, LONGEST_RETRY_S = 0.1, 3.0
PROBE_TIMEOUT_S = 3.0
"""Longest time in seconds that the check of the bucket may take."""
PROBE_VALID_S = 5.0
"""Time in seconds for which the result of the check is used again, because anybody may request `/readyz`."""
PROBE_NAME = "writable"
RETRY_AFTER_S = 5
_STATUS = re.compile(r"status[^0-9]{0,40}?(\d{3})", re.IGNORECASE)
BLOBS = "blobs"
OBJECTS_AT_ONCE = 1000
"""Number of objects in a page of a list, and in a request that deletes objects."""


@dataclass(frozen=True)
class Bucket:
    """Address of a bucket, and the credentials for it.

    Without `key_id`, the credentials are those of the standard environment variables (`AWS_ACCESS_KEY_ID` and so on),
    or of the role of the machine or pod. `timeout_s` limits each request; with all retries, a call takes at most twice
    this time.
    """

    name: str
    endpoint: str | None = None
    region: str = "us-east-1"
    prefix: str = ""
    key_id: str | None = None
    secret_key: str | None = field(default=None, repr=False)
    timeout_s: float = 30.0

    @property
    def shown(self) -> str:
        """The address of the bucket, without credentials."""
        return f"{self.endpoint or 'Amazon S3'}, bucket {self.name}"


@dataclass(frozen=True, slots=True)
class StoredObject:
    """Object with the bytes of a blob.

    `id` contains the time at which the transfer of the object began, and a random number. So each transfer has a name
    of its own, and a delayed request to delete an object cannot delete a later copy of the same bytes.
    """

    digest: str
    id: str

    @classmethod
    def new(cls, digest: str, began_us: int) -> Self:
        """Return an object with a new name, whose transfer begins at the time `began_us` of the database's clock."""
        return cls(digest, f"{began_us:016x}-{secrets.token_hex(8)}")

    @classmethod
    def parse(cls, name: str) -> Self | None:
        """Parse the name of an object, without looking for it; None if the name has not the form of a blob's name."""
        parts = name.split("/")
        if len(parts) != 4 or parts[0] != BLOBS or len(parts[3]) != 33:
            return None
        return cls(f"sha256:{parts[1]}{parts[2]}", parts[3])

    @property
    def name(self) -> str:
        """Name of the object in the bucket, without the prefix that the settings give."""
        digits = self.digest.removeprefix("sha256:")
        return f"{BLOBS}/{digits[:2]}/{digits[2:]}/{self.id}"

    @property
    def began_us(self) -> int:
        """Time at which the transfer of the object began, in microseconds since 1970, by the clock of the database."""
        return int(self.id.partition("-")[0], 16)


class ObjectStorageProblem(UnavailableProblem):
    """The object storage does not answer, or refuses a request."""

    code = "object-storage-unavailable"


class ObjectStorage:
    """Client for the objects of a bucket. Raises `ObjectStorageProblem` if a request fails after all retries."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket
        self._store = _connect(bucket, bucket.timeout_s, RETRIES)
        self._probe = _connect(bucket, PROBE_TIMEOUT_S, 0)
        self._probed: tuple[float, str | None] | None = None
        self._probing = threading.Lock()

    def put(self, name: str, chunks: Iterable[bytes]) -> None:
        """Store bytes under a new name. The server checks the SHA-256 of the object, or of each of its parts."""
        import obstore

        rest = iter(chunks)
        first = b"".join(_up_to(rest, PART_BYTES))
        second = next(rest, b"")
        with self._reporting("stored"):
            if not second:
                self._put_new(name, first)
                return
            whole = chain((first, second), rest)
            obstore.put(self._store, name, whole, chunk_size=PART_BYTES, max_concurrency=PARTS_AT_ONCE)

    def _put_new(self, name: str, data: bytes) -> None:
        import obstore
        from obstore.exceptions import AlreadyExistsError, NotSupportedError

        try:
            obstore.put(self._store, name, data, mode="create", use_multipart=False)
        except AlreadyExistsError:
            # An earlier try of this request was carried out, but its answer was lost; nobody else uses the name.
            log.info("an object was stored by an earlier try of the same request")
        except NotSupportedError:  # by servers without conditional writes
            obstore.put(self._store, name, data, use_multipart=False)

    def read(self, name: str, start: int, stop: int) -> bytes | None:
        """Return the bytes `start` to `stop - 1` of an object, fewer if it is shorter; None if there is no object."""
        import obstore
        from obstore.exceptions import BaseError

        with self._reporting("read"):
            try:
                if start < stop:
                    return bytes(obstore.get_range(self._store, name, start=start, end=stop))
            except FileNotFoundError:
                return None
            except BaseError:  # some servers refuse a range that begins after the end of a truncated object
                if (size_bytes := self.size_of(name)) is not None and size_bytes > start:
                    raise
            return b""

    def chunks(self, name: str) -> Iterator[bytes]:
        """Yield all bytes of an object, part by part; yield nothing if there is no object."""
        size_bytes = self.size_of(name) or 0
        for start in range(0, size_bytes, PART_BYTES):
            yield self.read(name, start, min(start + PART_BYTES, size_bytes)) or b""

    def size_of(self, name: str) -> int | None:
        """Return the size of an object in bytes; None if there is no object."""
        import obstore

        with self._reporting("read"):
            try:
                return obstore.head(self._store, name)["size"]
            except FileNotFoundError:
                return None

    def pages(self) -> Iterator[list[StoredObject]]:
        """Yield the objects of blobs, at most `OBJECTS_AT_ONCE` at a time, in the order of their names."""
        import obstore

        with self._reporting("listed"):
            for page in obstore.list(self._store, BLOBS, chunk_size=OBJECTS_AT_ONCE):
                yield [one for meta in page if (one := StoredObject.parse(meta["path"])) is not None]

    def delete(self, names: Sequence[str]) -> None:
        """Delete objects; those that do not exist are ignored."""
        import obstore

        with self._reporting("deleted"), suppress(FileNotFoundError):
            obstore.delete(self._store, names)

    def signed_url(self, name: str, valid_s: int) -> str:
        """Return a URL with which anybody can read an object for `valid_s` seconds."""
        import obstore

        with self._reporting("read"):
            return obstore.sign(self._store, "GET", name, timedelta(seconds=valid_s))

    def fault(self) -> str | None:
        """Store a small object as a check; return the reason why no object can be stored, or None if one can.

        The result of the check is used for `PROBE_VALID_S` seconds.
        """
        import obstore
        from obstore.exceptions import BaseError

        with self._probing:  # those who ask meanwhile get the same result
            if self._probed is not None and time.monotonic() < self._probed[0] + PROBE_VALID_S:
                return self._probed[1]
            fault = None
            try:
                obstore.put(self._probe, PROBE_NAME, b"", use_multipart=False)
            except (BaseError, OSError) as error:
                fault = f"{self.bucket.shown} {_reason(error)}"
            self._probed = (time.monotonic(), fault)
            return fault

    @contextmanager
    def _reporting(self, action: str) -> Iterator[None]:
        """Convert the errors of the client into `ObjectStorageProblem`, and log them; they contain no credentials."""
        from obstore.exceptions import BaseError

        try:
            yield
        except (BaseError, OSError) as error:
            log.warning("an object cannot be %s: %s %s", action, self.bucket.shown, _reason(error))
            raise ObjectStorageProblem(
                "The object storage that keeps the bytes of blobs does not answer as it should; nothing was changed. "
                "Try again.",
                headers={"Retry-After": str(RETRY_AFTER_S)},
            ) from error


def _connect(bucket: Bucket, timeout_s: float, retries: int) -> S3Store:
    from obstore.store import S3Store

    config: S3Config = {"region": bucket.region, "checksum_algorithm": "SHA256"}
    if bucket.endpoint is not None:
        config["endpoint"] = bucket.endpoint
    if bucket.key_id is not None:
        config["access_key_id"] = bucket.key_id
        config["secret_access_key"] = bucket.secret_key or ""
    return S3Store(
        bucket.name,
        prefix=bucket.prefix or None,
        config=config,
        client_options={
            "timeout": timedelta(seconds=timeout_s),
            "connect_timeout": timedelta(seconds=min(CONNECT_TIMEOUT_S, timeout_s)),
            "allow_http": (bucket.endpoint or "").startswith("http://"),
        },
        retry_config={
            "max_retries": retries,
            "retry_timeout": timedelta(seconds=timeout_s),
            "backoff": {
                "init_backoff": timedelta(seconds=FIRST_RETRY_S),
                "max_backoff": timedelta(seconds=LONGEST_RETRY_S),
                "base": 2,
            },
        },
    )


def _up_to(chunks: Iterator[bytes], size_bytes: int) -> Iterator[bytes]:
    """Yield chunks until they have at least `size_bytes` together."""
    while size_bytes > 0 and (chunk := next(chunks, b"")):
        size_bytes -= len(chunk)
        yield chunk


def _reason(error: Exception) -> str:
    """Return the reason of a failed request, in a few words that contain neither a signature nor a credential."""
    text = str(error)
    found = _STATUS.search(text)
    status = found[1] if found is not None else ""
    if status in ("401", "403"):
        return "refuses the credentials"
    if isinstance(error, FileNotFoundError) or "NoSuchBucket" in text:
        return "does not exist"
    if status:
        return f"answers with the status {status}"
    return "does not answer in time" if "timed out" in text or "TimedOut" in text else "cannot be reached"
