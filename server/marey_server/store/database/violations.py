"""Recognises the error of a database about a name that is taken."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import exc

from marey_server.errors import ApiProblem

_POSTGRES_UNIQUE = "23505"


def is_unique_violation(error: exc.IntegrityError) -> bool:
    """Return whether a unique index refused the row."""
    state = getattr(error.orig, "sqlstate", None)
    return state == _POSTGRES_UNIQUE if state else "UNIQUE constraint failed" in str(error.orig)


@contextmanager
def taken(error: ApiProblem) -> Iterator[None]:
    """Raise `error` where a statement inside fails because a unique name is taken. The transaction is then over."""
    try:
        yield
    except exc.IntegrityError as violation:
        if is_unique_violation(violation):
            raise error from violation
        raise
