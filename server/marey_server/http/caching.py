"""Values of the header `Cache-Control`: how long clients may keep an answer."""

from __future__ import annotations

from types import MappingProxyType

IMMUTABLE = "private, max-age=31536000, immutable"
"""Value for an answer that never changes, which clients may keep for a year."""

REVALIDATED = "private, no-cache"
"""Value for an answer that clients may keep, but must revalidate with the server before each use."""

NOT_STORED = "no-store"
"""Value for an answer that clients must not keep."""

WITH_SECRET = MappingProxyType({"Cache-Control": NOT_STORED})
"""Headers of an answer that contains a password, a token or another secret."""


def caching_of_revision(named: int | None) -> str:
    """Return the Cache-Control of an answer that shows the revision `named`; None: the newest revision."""
    return REVALIDATED if named is None else IMMUTABLE
