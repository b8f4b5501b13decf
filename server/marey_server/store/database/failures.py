"""Failures of the database: which failed transactions are retried, and to which errors other failures are converted."""

from __future__ import annotations

import errno

from sqlalchemy import exc

from marey_schemas.backoff import Backoff
from marey_server.errors import InvalidProblem, StorageFullProblem, UnavailableProblem
from marey_server.store import tables

WRITE_TRIES = 5
WRITE_BACKOFF = Backoff(first_s=0.02, longest_s=0.16, jitter=1.0)
READ_TRIES = 3
"""Greatest number of runs of a read; only a broken connection makes it run again, at once, on a new connection."""
FAILURES = (exc.DBAPIError, exc.TimeoutError, OSError, OverflowError, UnicodeEncodeError)
"""Types of the errors that the database, its driver or the connection raises during a transaction."""


def worth_retrying(error: Exception) -> bool:
    """Return whether a transaction that failed may succeed if it runs again."""
    if not isinstance(error, exc.DBAPIError):
        return False
    constraint = getattr(getattr(error.orig, "diag", None), "constraint_name", None)
    return (
        error.connection_invalidated
        or getattr(error.orig, "sqlstate", None) in _TRY_AGAIN
        or constraint == tables.ONE_RUNS_PER_KEY
    )


_TRY_AGAIN = ("40001", "40P01")
"""SQLSTATE codes after which a transaction is retried: serialisation failure, deadlock."""


def translated(error: Exception) -> Exception:
    """Convert a failure of the database into an error of the server, if the caller can react to the failure.

    Other failures are returned unchanged.
    """
    if isinstance(error, OSError):
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        detail = "The disk of the server has no space left; nothing was written. Ask the operator to free space."
        return StorageFullProblem(detail) if full else error
    if isinstance(error, exc.TimeoutError):
        return no_answer("All connections to the database are in use; nothing was written. Try again.")
    if isinstance(error, OverflowError | UnicodeEncodeError | exc.DataError):
        return InvalidProblem(
            "The request contains a number or text that the database cannot store, such as an integer of more than 64 "
            "bits or a text with the character NUL.",
            code="bad-value",
        )
    if not isinstance(error, exc.DBAPIError):
        return error
    message = str(error.orig)
    if "disk is full" in message or getattr(error.orig, "sqlstate", None) == "53100":
        detail = "The disk of the database has no space left; nothing was written. Ask the operator to free space."
        return StorageFullProblem(detail)
    if isinstance(error, exc.OperationalError) and not message.startswith(("no such", "near ")):  # faults of the server
        return no_answer("The database does not answer; nothing was written. Try again.")
    return error


def no_answer(detail: str) -> UnavailableProblem:
    """Return the error for a database that does not answer."""
    return UnavailableProblem(detail, headers={"Retry-After": "2"})
