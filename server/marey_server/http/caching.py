"""Values of the header `Cache-Control`: how long clients may keep an answer."""

from __future__ import annotations

from types import MappingProxyType

IMMUTABLE = "private, max-age=31536000, immutable"
"""Of an answer that never changes."""

REVALIDATED = "private, no-cache"
"""Of an answer that clients may keep, but must not use again without asking the server whether it has changed."""

NOT_STORED = "no-store"
"""Of an answer that clients must not keep."""

WITH_SECRET = MappingProxyType({"Cache-Control": NOT_STORED})
"""Headers of an answer that contains a password, a token or another secret."""


def caching_of_revision(named: int | None) -> str:
    """Return the caching of an answer about a revision that the request names; None: about the newest one."""
    return REVALIDATED if named is None else IMMUTABLE
