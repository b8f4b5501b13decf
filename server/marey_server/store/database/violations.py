"""Recognition of database errors which mean that a name exists already."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import exc

from marey_server.errors import ApiProblem

_POSTGRES_UNIQUE = "23505"


def is_unique_violation(error: exc.IntegrityError) -> bool:
    """Return whether an error is the violation of a unique index."""
    state = getattr(error.orig, "sqlstate", None)
    return state == _POSTGRES_UNIQUE if state else "UNIQUE constraint failed" in str(error.orig)


@contextmanager
def taken(error: ApiProblem) -> Iterator[None]:
    """Raise `error` if a statement in the `with` block violates a unique index.

    After such a violation, the transaction cannot be used any more.
    """
    try:
        yield
    except exc.IntegrityError as violation:
        if is_unique_violation(violation):
            raise error from violation
        raise
