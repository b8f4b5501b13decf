"""Password hashes by scrypt (RFC 7914), stored as text together with their parameters."""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
from typing import NamedTuple

LOG2_N = 15
"""Cost parameter of scrypt: 2**15 blocks of 1 KiB need 32 MiB and about 0.1 s per guess."""

_BLOCK = 8
_PARALLEL = 1
_KEY_BYTES = 32
_MAX_MEMORY = 256 * 2**20


class _Parsed(NamedTuple):
    log2_n: int
    block: int
    parallel: int
    salt: bytes
    key: bytes


def hash_password(password: str) -> str:
    """Hash a password with a random salt, and return `scrypt$15$8$1$<salt>$<key>`.

    Hashing takes about 0.1 s, so this function must not run on the event loop.
    """
    salt = secrets.token_bytes(16)
    key = _derive(password, salt, LOG2_N, _BLOCK, _PARALLEL, _KEY_BYTES)
    return "$".join(("scrypt", str(LOG2_N), str(_BLOCK), str(_PARALLEL), _text(salt), _text(key)))


def password_matches(password: str, stored: str | None) -> bool:
    """Return whether `password` matches the hash `stored`.

    If `stored` is None, return False, but only after the time that a comparison takes.
    """
    parsed = _parse(stored or _nobody())
    key = _derive(password, parsed.salt, parsed.log2_n, parsed.block, parsed.parallel, len(parsed.key))
    return hmac.compare_digest(key, parsed.key) and stored is not None


def _derive(password: str, salt: bytes, log2_n: int, block: int, parallel: int, length: int) -> bytes:
    return hashlib.scrypt(
        password.encode("utf-8", "surrogatepass"),
        salt=salt,
        n=1 << log2_n,
        r=block,
        p=parallel,
        dklen=length,
        maxmem=_MAX_MEMORY,
    )


def _parse(stored: str) -> _Parsed:
    _name, log2_n, block, parallel, salt, key = stored.split("$")
    return _Parsed(int(log2_n), int(block), int(parallel), base64.b64decode(salt), base64.b64decode(key))


def _nobody() -> str:
    """Return a hash that no password matches, so that checking an unknown user takes as long as a known one."""
    return "$".join(("scrypt", str(LOG2_N), str(_BLOCK), str(_PARALLEL), _text(bytes(16)), _text(bytes(_KEY_BYTES))))


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
