"""Blobs: bytes named by their SHA-256 and stored once, and the rules for access to them (docs/decisions/0006, 0021)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any

from sqlalchemy import ColumnElement, Select, Table, and_, or_, select, update

from marey_schemas.access import Scope
from marey_schemas.encoding.digests import digest_of
from marey_schemas.problems import FieldError
from marey_server import faults
from marey_server.access import scopes
from marey_server.access.principal import Principal
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    UnauthenticatedProblem,
)
from marey_server.store.blob_backings import CHUNK_BYTES, Spool
from marey_server.store.jobs import reach
from marey_server.store.object_storage.client import StoredObject
from marey_server.store.projects import is_visible, writable_projects
from marey_server.store.quotas.daily import count_sent
from marey_server.store.tables import (
    attempt_blob,
    blob,
    blob_holder,
    document_blob,
    item,
    job,
    job_blob,
    project,
    revision,
    revision_part,
)
from marey_server.store.transaction import Transaction, in_lists

GRACE_US = 24 * 3600 * 1_000_000
"""Time after which garbage collection deletes a blob or document that nothing refers to."""

RENEW_US = GRACE_US // 2
"""Age after which an unreferenced blob must be sent again, so that it is not deleted while a client relies on it."""


def put_blob(
    tx: Transaction, content: bytes | Spool, *, expected: str | None = None, project_id: str | None = None
) -> str:
    """Store bytes that the caller uploaded, and allow the caller to refer to them by their digest; return the digest.

    The bytes can be used in the project `project_id`, or if this is None, in all projects that the caller's token
    allows. Raises `InvalidProblem` if the digest of the bytes is not `expected`, and `QuotaExceededProblem` if the
    caller has sent too many bytes.
    """
    digest = expected or _digest(content)
    count_sent(tx, put_uncounted(tx, {digest: content}, project_id=project_id))
    faults.point("blob.put.before_commit")
    tx.after_commit(lambda: faults.point("blob.put.after_commit"))
    return digest


def put_uncounted(tx: Transaction, contents: Mapping[str, bytes | Spool], *, project_id: str | None = None) -> int:
    """Store bytes under their digests as `put_blob` does, but without counting them; return the number of new bytes.

    Pass this number to `count_sent` at the end of the transaction: until the transaction ends, everybody who counts
    bytes of the same user waits.
    """
    require_sender(tx.principal)
    places = places_of_sender(tx) if project_id is None else (project_id,)
    for expected, content in contents.items():
        if (digest := _digest(content)) != expected:
            raise InvalidProblem(
                f"The bytes have the digest {digest}, not {expected}: they were changed in transit; send them again.",
                code="digest-mismatch",
            )
    new = store_blobs(tx, contents)
    for digest in sorted(contents):
        add_holder(tx, digest, places)
    return sum(_size_bytes(contents[digest]) for digest in new)


def require_sender(principal: Principal) -> None:
    """Raise an error unless the caller may upload bytes.

    Users need a token with the scope `write` for at least one project; attempts of jobs need no scope.
    """
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to upload data.")
    if principal.kind == "user" and not any(held.partition("!")[0] == "write" for held in principal.scopes):
        raise ForbiddenProblem("Uploads need a token with the scope 'write'.", code="insufficient-scope")


EVERY_PROJECT = ""
"""Value in place of a project id, for bytes sent with a token that is valid for all projects."""


def places_of_sender(tx: Transaction) -> tuple[str, ...]:
    """Return the ids of the projects in which the caller can use bytes after uploading them, or `EVERY_PROJECT`.

    Raises `ForbiddenProblem` if the caller's token is limited to certain projects, and the user may write in none of
    these.
    """
    names = scopes.projects_of(tx.principal.scopes, "write")
    if tx.principal.kind != "user" or EVERY_PROJECT in names:
        return (EVERY_PROJECT,)
    if not (found := writable_projects(tx, names)):
        raise ForbiddenProblem(
            "Uploads need a token with the scope 'write' for a project in which you may write.",
            code="insufficient-scope",
        )
    return tuple(found)


def store_blobs(tx: Transaction, contents: Mapping[str, bytes | Spool]) -> set[str]:
    """Store bytes under their digests; for blobs that are stored already, reset the age to zero.

    Returns the digests of the blobs that were not stored before.
    """
    rows = [
        {"digest": digest, "size_bytes": _size_bytes(content), "created_us": tx.now_us}
        for digest, content in contents.items()
    ]
    new = insert_new(tx, blob, rows)
    tx.blobs.write(tx.connection, {digest: _chunks(contents[digest]) for digest in contents if digest in new})
    return new


def _digest(content: bytes | Spool) -> str:
    return digest_of(content) if isinstance(content, bytes) else content.digest


def _size_bytes(content: bytes | Spool) -> int:
    return len(content) if isinstance(content, bytes) else content.size_bytes


def _chunks(content: bytes | Spool) -> Iterable[bytes]:
    if not isinstance(content, bytes):
        return content.chunks()
    if len(content) <= CHUNK_BYTES:
        return [content] if content else []
    return (content[start : start + CHUNK_BYTES] for start in range(0, len(content), CHUNK_BYTES))


def insert_new(tx: Transaction, table: Table, rows: Iterable[dict[str, Any]]) -> set[str]:
    """Insert rows keyed by `digest`, or reset the age of existing rows to zero; return the digests of the new rows.

    New and existing rows are locked until the transaction ends, so that garbage collection cannot delete them.
    """
    new: set[str] = set()
    added = tx.insert_or_ignore(table).returning(table.c.digest)
    waiting = {row["digest"]: row for row in sorted(rows, key=itemgetter("digest"))}
    while waiting:
        for some in in_lists(list(waiting)):
            made = set(tx.execute(added, [waiting[digest] for digest in some]).scalars())
            new |= made
            for digest in made | _renew(tx, table, set(some) - made):
                del waiting[digest]
    return new


def _renew(tx: Transaction, table: Table, digests: Iterable[str]) -> set[str]:
    """Reset the age of existing rows to zero, and lock these rows; return their digests."""
    there: set[str] = set()
    for some in in_lists(sorted(digests)):
        chosen = table.c.digest.in_(some)
        if tx.is_postgres:  # in one order, so that no two writes wait for each other
            rows = select(table.c.digest).where(chosen).order_by(table.c.digest)
            tx.execute(rows.with_for_update(key_share=True))
        renewed = update(table).where(chosen).values(created_us=tx.now_us).returning(table.c.digest)
        there.update(tx.execute(renewed).scalars())
    return there


def add_holder(tx: Transaction, digest: str, places: Iterable[str]) -> None:
    """Record that the caller has uploaded the bytes of a blob and may refer to the blob.

    A user may refer to the blob in the projects `places`; an attempt of a job, only in requests of this attempt.
    """
    caller = tx.principal
    if caller.kind == "attempt":
        row = {"digest": digest, "job_id": caller.job_id, "fence": caller.fence, "created_us": tx.now_us}
        tx.execute(tx.insert_or_ignore(attempt_blob, row))
    elif caller.user_id is not None:
        common = {"digest": digest, "user_id": caller.user_id, "created_us": tx.now_us}
        rows = [{**common, "project_id": place} for place in places]
        tx.execute(tx.insert_or_ignore(blob_holder), rows)


def lock_usable(tx: Transaction, digests: Iterable[str]) -> set[str]:
    """Return those of the digests that the caller may refer to, and lock their blobs.

    Garbage collection cannot delete the locked blobs before the end of this transaction.
    """
    return _renew(tx, blob, readable(tx, digests))


def keep_for_job(tx: Transaction, job_id: str, digests: Iterable[str]) -> None:
    """Keep the blobs to which a job's parameters or result refer, and let readers of the job's project read them.

    Raises `ConflictProblem` (`missing-blobs`) if a blob is not stored or the caller may not refer to it.
    """
    wanted = set(digests)
    if lacking := wanted - lock_usable(tx, wanted):
        raise missing_blobs(lacking)
    _name_for_job(tx, job_id, wanted)


def share_with_job(tx: Transaction, job_id: str, digests: Iterable[str]) -> bool:
    """Prevent the deletion of the blobs in a result that a job gets from an identical job.

    Returns whether all these blobs are still stored.
    """
    wanted = set(digests)
    if wanted - _renew(tx, blob, wanted):
        return False
    _name_for_job(tx, job_id, wanted)
    return True


def _name_for_job(tx: Transaction, job_id: str, digests: Iterable[str]) -> None:
    for digest in sorted(digests):
        tx.execute(tx.insert_or_ignore(job_blob, {"job_id": job_id, "blob_digest": digest}))


def missing_blobs(digests: Iterable[str], errors: Sequence[FieldError] = ()) -> ConflictProblem:
    """Return the error for a document or job that refers to blobs that are not stored."""
    detail = "The request refers to blobs that the server does not have; upload them first."
    return ConflictProblem(detail, code="missing-blobs", context={"missing": sorted(set(digests))}, errors=errors)


# -- reading ----------------------------------------------------------------------------------------------------------


def readable(tx: Transaction, digests: Iterable[str]) -> set[str]:
    """Return the digests of stored blobs that the caller may read and refer to."""
    wanted = set(digests)
    held = _held(tx, wanted, since_us=0)
    return held | _referenced(tx, wanted - held)


def missing(tx: Transaction, digests: Iterable[str]) -> list[str]:
    """Return, in order, the digests of blobs that the caller must send before referring to them."""
    digests = list(dict.fromkeys(digests))
    there = _referenced(tx, digests)
    there |= _held(tx, [digest for digest in digests if digest not in there], since_us=tx.now_us - RENEW_US)
    return [digest for digest in digests if digest not in there]


def require_readable(tx: Transaction, digest: str) -> int:
    """Return the size of a blob in bytes.

    Raises `NotFoundProblem` if the blob is missing or the caller may not read it.
    """
    return sizes_of_readable(tx, [digest])[digest]


def sizes_of_readable(tx: Transaction, digests: Collection[str]) -> dict[str, int]:
    """Return the sizes of blobs in bytes, by digest.

    Raises `NotFoundProblem` if the caller may not read one of the blobs.
    """
    sizes = sizes_of(tx, readable(tx, digests))
    for digest in digests:
        if digest not in sizes:
            raise NotFoundProblem(f"There is no blob {digest} that you may read.")
    return sizes


def sizes_of(tx: Transaction, digests: Iterable[str]) -> dict[str, int]:
    """Return the sizes of stored blobs in bytes, by digest, without a check of access."""
    sizes: dict[str, int] = {}
    for some in in_lists(digests):
        rows = tx.execute(select(blob.c.digest, blob.c.size_bytes).where(blob.c.digest.in_(some)))
        sizes.update((row.digest, row.size_bytes) for row in rows)
    return sizes


def read_blob(tx: Transaction, digest: str, start: int = 0, stop: int | None = None) -> bytes:
    """Return the bytes `start` to `stop - 1` of a blob; by default, all. Access must have been checked before."""
    if stop is None:
        stop = int(tx.execute(select(blob.c.size_bytes).where(blob.c.digest == digest)).scalar_one())
    return b"".join(tx.blobs.read(tx.connection, digest, start, stop))


def object_of(tx: Transaction, digest: str) -> StoredObject | None:
    """Return the object in the object storage that contains a blob, or None if the blob is stored elsewhere.

    Access must have been checked before.
    """
    found = tx.execute(select(blob.c.object_id).where(blob.c.digest == digest)).scalar()
    return StoredObject(digest, found) if found else None


def read_range(tx: Transaction, digest: str, start: int, stop: int) -> bytes:
    """Return the bytes `start` to `stop - 1` of a blob that the caller may read; pass a range of a few MiB at most.

    Raises `NotFoundProblem` if the blob is missing or the caller may not read it.
    """
    size = require_readable(tx, digest)
    return read_blob(tx, digest, start, min(stop, size))


def _held(tx: Transaction, digests: Iterable[str], *, since_us: int) -> set[str]:
    caller = tx.principal
    young = select(blob.c.digest).where(blob.c.created_us >= since_us)
    if caller.kind == "attempt":
        mine = (attempt_blob.c.job_id == caller.job_id, attempt_blob.c.fence == caller.fence)
        statement = young.join(attempt_blob, attempt_blob.c.digest == blob.c.digest).where(*mine)
    elif caller.user_id is not None:
        statement = young.join(blob_holder, blob_holder.c.digest == blob.c.digest)
        statement = statement.where(blob_holder.c.user_id == caller.user_id, *_within_reach(caller)).distinct()
    else:
        return set()
    return _collect(tx, statement, blob.c.digest, digests)


def _within_reach(caller: Principal) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions for the uploads of a user whose bytes the user's token may use.

    The uploads are rows of `blob_holder`; each row is valid in one project or in every project. A token that may read
    in all projects may use all uploads of its user. Any other token may use the uploads that are valid in the projects
    named in the token's scopes. If a scope of the token is for all projects, the token may also use the uploads that
    are valid in every project.
    """
    if scopes.allows(caller.scopes, "read"):
        return ()
    names = scopes.projects_of(caller.scopes, *_USES)
    within = blob_holder.c.project_id.in_(_ids_of(names))
    return (or_(within, blob_holder.c.project_id == EVERY_PROJECT) if EVERY_PROJECT in names else within,)


def reaches(tx: Transaction, places: Collection[str]) -> bool:
    """Return whether the caller's token is valid for all projects with the ids `places`."""
    caller = tx.principal
    names = scopes.projects_of(caller.scopes, *_USES)
    return EVERY_PROJECT in names or set(places) <= set(tx.execute(_ids_of(names)).scalars())


_USES = (Scope.READ, Scope.WRITE, Scope.JOBS)
"""Scopes with which a token may use bytes that its user sent."""


def _ids_of(names: Iterable[str]) -> Select[tuple[str]]:
    return select(project.c.id).where(project.c.name.in_(list(names)), project.c.deleted_us.is_(None))


def _referenced(tx: Transaction, digests: Iterable[str]) -> set[str]:
    digests = list(digests)
    if tx.principal.kind == "attempt":
        return reach.reachable_blobs(tx, digests)
    visible = is_visible(tx.principal)
    of_revision = and_(revision.c.item_id == revision_part.c.item_id, revision.c.number == revision_part.c.number)
    by_document = (
        select(document_blob.c.blob_digest)
        .join(revision_part, revision_part.c.document_digest == document_blob.c.document_digest)
        .join(revision, of_revision)
        .join(item, item.c.id == revision_part.c.item_id)
        .join(project, project.c.id == item.c.project_id)
        .where(or_(item.c.deleted_us.is_(None), revision.c.content.is_not(None)), visible)  # versions keep content
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
    for some in in_lists(digests):
        found.update(tx.execute(statement.where(column.in_(some))).scalars())
    return found
