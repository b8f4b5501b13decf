"""Blobs: bytes named by their SHA-256, stored once, readable by those who may (docs/decisions/0006-possession.md)."""

from __future__ import annotations

import hashlib
import itertools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from sqlalchemy import ColumnElement, Select, Table, select, update

from marey_schemas.problems import FieldError
from marey_server import faults
from marey_server.access.principal import Principal
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    UnauthenticatedProblem,
)
from marey_server.store.blob_backings import CHUNK_BYTES
from marey_server.store.projects import is_visible
from marey_server.store.tables import (
    blob,
    blob_holder,
    document_blob,
    item,
    job,
    job_blob,
    project,
    revision_part,
)
from marey_server.store.transaction import Transaction

GRACE_US = 24 * 3600 * 1_000_000
"""How long a blob or document that nothing refers to is left alone."""

RENEW_US = GRACE_US // 2
"""What is older than this and unreferenced must be sent again, so that it cannot vanish while somebody relies on it."""

IN_LIST = 500


class Spool:
    """Bytes on their way in: hashed as they come, in memory up to 1 MiB, then in a temporary file without a name."""

    def __init__(self, directory: str | None = None) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=CHUNK_BYTES, dir=directory)  # noqa: SIM115
        self._hash = hashlib.sha256()
        self.size_bytes = 0

    def write(self, data: bytes) -> None:
        """Append bytes."""
        self._file.write(data)
        self._hash.update(data)
        self.size_bytes += len(data)

    @property
    def digest(self) -> str:
        """The name of what was written so far."""
        return f"sha256:{self._hash.hexdigest()}"

    def chunks(self) -> Iterator[bytes]:
        """Everything written, from the start, in pieces of 1 MiB."""
        self._file.seek(0)
        while chunk := self._file.read(CHUNK_BYTES):
            yield chunk

    def close(self) -> None:
        """Drop the bytes."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _at: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Pieces:
    """Bytes that lie elsewhere, to be read in pieces of 1 MiB when they are wanted."""

    size_bytes: int
    chunks: Callable[[], Iterable[bytes]]


def digest_of(data: bytes) -> str:
    """`sha256:<hex>` of bytes."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def put_blob(tx: Transaction, content: bytes | Spool, *, expected: str | None = None) -> str:
    """Store bytes that the caller sent; from now on the caller may refer to them by their digest.

    Raises `InvalidProblem` where they are not the bytes that `expected` names.
    """
    require_sender(tx.principal)
    digest = digest_of(content) if isinstance(content, bytes) else content.digest
    if expected is not None and digest != expected:
        raise InvalidProblem(
            f"The bytes are {digest}, not {expected}: they were changed in transit.", code="digest-mismatch"
        )
    store_blob(tx, digest, content)
    add_holder(tx, digest)
    faults.point("blob.put.before_commit")
    tx.after_commit(lambda: faults.point("blob.put.after_commit"))
    return digest


def require_sender(principal: Principal) -> None:
    """Raise unless the caller may send bytes: users with the scope `write`, whatever it is bound to, and attempts."""
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to send bytes.")
    if principal.kind == "user" and not any(held.partition("!")[0] == "write" for held in principal.scopes):
        raise ForbiddenProblem("This token may not write.", code="insufficient-scope")


def store_blob(tx: Transaction, digest: str, content: bytes | Spool | Pieces) -> None:
    """Store bytes under their digest, once; bytes that are there already count as new again."""
    size_bytes = len(content) if isinstance(content, bytes) else content.size_bytes
    row = {"digest": digest, "size_bytes": size_bytes, "created_us": tx.now_us}
    if insert_new(tx, blob, row):
        tx.blobs.write(tx.connection, digest, _chunks(content))


def _chunks(content: bytes | Spool | Pieces) -> Iterable[bytes]:
    if not isinstance(content, bytes):
        return content.chunks()
    if len(content) <= CHUNK_BYTES:
        return [content] if content else []
    return (content[start : start + CHUNK_BYTES] for start in range(0, len(content), CHUNK_BYTES))


def insert_new(tx: Transaction, table: Table, row: dict[str, Any]) -> bool:
    """Insert a row keyed by `digest`, or renew the one that is there. True if it is new.

    Either way the row is locked until the transaction ends, so that garbage collection cannot take it.
    """
    added = tx.insert_or_ignore(table, row).returning(table.c.digest)
    renew = update(table).where(table.c.digest == row["digest"]).values(created_us=tx.now_us)
    while True:
        if tx.execute(added).first() is not None:
            return True
        if tx.execute(renew).rowcount:
            return False


def add_holder(tx: Transaction, digest: str) -> None:
    """Note that the caller has shown to possess the bytes."""
    if tx.principal.user_id is None:
        return
    row = {"digest": digest, "user_id": tx.principal.user_id, "created_us": tx.now_us}
    tx.execute(tx.insert_or_ignore(blob_holder, row))


def hold(tx: Transaction, digests: Iterable[str]) -> set[str]:
    """Return those of `digests` that the caller may refer to, locked so that they stay until this write has done so."""
    allowed = sorted(readable(tx, digests))
    renew = update(blob).values(created_us=tx.now_us).returning(blob.c.digest)
    return {digest for digest in allowed if tx.execute(renew.where(blob.c.digest == digest)).first() is not None}


def keep_for_job(tx: Transaction, job_id: str, digests: Iterable[str]) -> None:
    """Keep blobs that a job's parameters or result name; who may read the job's project may read them.

    Raises `ConflictProblem` (`missing-blobs`) where the caller may not refer to one, or it is not there.
    """
    wanted = set(digests)
    if lacking := wanted - hold(tx, wanted):
        raise missing_blobs(lacking)
    for digest in sorted(wanted):
        tx.execute(tx.insert_or_ignore(job_blob, {"job_id": job_id, "blob_digest": digest}))


def missing_blobs(digests: Iterable[str], errors: Sequence[FieldError] = ()) -> ConflictProblem:
    """Something names blobs that are not here."""
    detail = "This names blobs that are not here; send them first."
    return ConflictProblem(detail, code="missing-blobs", context={"missing": sorted(set(digests))}, errors=errors)


# -- reading ----------------------------------------------------------------------------------------------------------


def readable(tx: Transaction, digests: Iterable[str]) -> set[str]:
    """Return those of `digests` that are stored and that the caller may read or refer to."""
    return _held(tx, digests, since_us=0) | _referenced(tx, digests)


def missing(tx: Transaction, digests: Iterable[str]) -> list[str]:
    """Return those of `digests` that the caller must send before referring to them, in the order asked."""
    digests = list(dict.fromkeys(digests))
    there = _referenced(tx, digests)
    there |= _held(tx, [digest for digest in digests if digest not in there], since_us=tx.now_us - RENEW_US)
    return [digest for digest in digests if digest not in there]


def require_readable(tx: Transaction, digest: str) -> int:
    """Size of a blob in bytes. Raises `NotFoundProblem` where there is none that the caller may read."""
    size = tx.execute(select(blob.c.size_bytes).where(blob.c.digest == digest)).scalar()
    if size is None or not readable(tx, [digest]):
        raise NotFoundProblem(f"There is no blob {digest} that you may read.")
    return int(size)


def read_blob(tx: Transaction, digest: str, start: int = 0, stop: int | None = None) -> bytes:
    """Return bytes `start` to `stop` of a blob, for callers who have checked that they may be read."""
    if stop is None:
        stop = int(tx.execute(select(blob.c.size_bytes).where(blob.c.digest == digest)).scalar_one())
    return b"".join(tx.blobs.read(tx.connection, digest, start, stop))


def read_range(tx: Transaction, digest: str, start: int, stop: int) -> bytes:
    """Return bytes `start` to `stop` of a blob that the caller may read; ask for at most a few MiB at a time."""
    size = require_readable(tx, digest)
    return read_blob(tx, digest, start, min(stop, size))


def _held(tx: Transaction, digests: Iterable[str], *, since_us: int) -> set[str]:
    user_id = tx.principal.user_id
    if user_id is None:
        return set()
    statement = (
        select(blob.c.digest)
        .join(blob_holder, blob_holder.c.digest == blob.c.digest)
        .where(blob_holder.c.user_id == user_id, blob.c.created_us >= since_us)
    )
    return _collect(tx, statement, blob.c.digest, digests)


def _referenced(tx: Transaction, digests: Iterable[str]) -> set[str]:
    digests = list(digests)
    visible = is_visible(tx.principal)
    by_document = (
        select(document_blob.c.blob_digest)
        .join(revision_part, revision_part.c.document_digest == document_blob.c.document_digest)
        .join(item, item.c.id == revision_part.c.item_id)
        .join(project, project.c.id == item.c.project_id)
        .where(item.c.deleted_us.is_(None), visible)
        .distinct()
    )
    by_job = (
        select(job_blob.c.blob_digest)
        .join(job, job.c.id == job_blob.c.job_id)
        .join(project, project.c.id == job.c.project_id)
        .where(visible)
        .distinct()
    )
    return _collect(tx, by_document, document_blob.c.blob_digest, digests) | _collect(
        tx, by_job, job_blob.c.blob_digest, digests
    )


def _collect(
    tx: Transaction, statement: Select[tuple[str]], column: ColumnElement[str], digests: Iterable[str]
) -> set[str]:
    found: set[str] = set()
    for some in _batched(digests):
        found.update(tx.execute(statement.where(column.in_(some))).scalars())
    return found


def _batched(digests: Iterable[str]) -> Iterator[list[str]]:
    rest = iter(digests)
    while some := list(itertools.islice(rest, IN_LIST)):
        yield some
