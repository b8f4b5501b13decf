"""Digests that name content: `sha256:` and 64 hexadecimal digits."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Protocol


class Hashed(Protocol):
    """SHA-256 of bytes, which may have been added piece by piece."""

    def hexdigest(self) -> str:
        """Return the hash as hexadecimal digits."""


def digest_of(data: bytes | memoryview) -> str:
    """Return the digest of bytes, `sha256:` and 64 hexadecimal digits."""
    return digest_of_hash(hashlib.sha256(data))


def digest_of_hash(hashed: Hashed) -> str:
    """Return the digest of the bytes that were added to a SHA-256."""
    return f"sha256:{hashed.hexdigest()}"


def digest_of_file(path: Path) -> str:
    """Return the digest of a file's bytes, read in pieces."""
    with path.open("rb") as file:
        return digest_of_hash(hashlib.file_digest(file, "sha256"))
