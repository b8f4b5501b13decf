"""ID tokens of OpenID Connect: signing keys of an identity provider, and the checks of a token.

The library joserfc checks signatures and dates. This module chooses the key, and accepts only asymmetric algorithms: a
token that is signed with a public key as the secret of an HMAC, or not signed at all, is refused before any key is
used. The key of a token comes only from the provider's list of keys, never from the token itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from joserfc import jws, jwt
from joserfc.errors import ExpiredTokenError, InvalidClaimError, JoseError, MissingClaimError
from joserfc.jwk import ECKey, RSAKey

from marey_schemas.sizes import KIB

ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512")
"""Accepted algorithms of signatures."""
MOST_TOKEN_BYTES = 32 * KIB
MOST_HEADER_BYTES = 4 * KIB
MOST_KEYS = 64
RSA_BITS = range(2048, 8193)
MOST_EXPONENT_DIGITS = 8
"""Greatest number of base64 digits of a public RSA exponent, because a long exponent makes each check slow."""
_SUBJECT = re.compile(r"[\x20-\x7e]{1,255}")
_TYPES: dict[str, str] = {"R": "RSA", "P": "RSA", "E": "EC"}
"""Key type (`kty`) that an algorithm needs, by the first letter of the algorithm's name."""
_MEMBERS = {"RSA": ("kty", "n", "e"), "EC": ("kty", "crv", "x", "y")}
"""Members of a public key that are used; others, such as the private ones, are left out."""


class InvalidIdToken(Exception):
    """ID token that must not be accepted; the message is a clause, such as "the token has expired"."""


class UnknownSigningKey(InvalidIdToken):
    """ID token whose key is not among the known keys, perhaps because the provider uses new keys."""


@dataclass(frozen=True)
class SigningKey:
    """Public key with which an identity provider signs; a key with an `algorithm` is for this algorithm only."""

    key: RSAKey | ECKey
    key_id: str | None
    algorithm: str | None

    def fits(self, algorithm: str, key_id: str | None) -> bool:
        """Return whether this key can check the signature of a token.

        `algorithm` and `key_id` are given in the header of the token; `key_id` is None if the header names no key.
        """
        return (
            self.key.key_type == _TYPES[algorithm[0]]
            and self.algorithm in (None, algorithm)
            and (key_id is None or key_id == self.key_id)
        )


@dataclass(frozen=True)
class Expectation:
    """Values that the claims of a valid token must have; clocks may differ by `leeway_s` seconds."""

    issuer: str
    client_id: str
    nonce: str
    leeway_s: int


@dataclass(frozen=True)
class Person:
    """Person whom an identity provider has signed in; `issuer` and `subject` together identify the person.

    `name` and `display_name` are only suggestions for a new user.
    """

    issuer: str
    subject: str
    name: str | None = None
    display_name: str | None = None


def read_keys(document: Mapping[str, Any]) -> tuple[SigningKey, ...]:
    """Return the usable signing keys of a JSON Web Key Set; other keys are left out.

    Raises `ValueError` if the set is malformed, or has no usable key.
    """
    keys = document.get("keys")
    if not isinstance(keys, list) or len(keys) > MOST_KEYS:
        raise ValueError(f"the member `keys` of the key set is not a list of at most {MOST_KEYS} keys")
    found = tuple(key for key in map(_read_key, keys) if key is not None)
    if not found:
        raise ValueError("no key of the set can check signatures with an accepted algorithm")
    return found


def _read_key(data: Any) -> SigningKey | None:
    """Return a signing key from its JSON form; None if it is weak, malformed, or not for an accepted algorithm."""
    if not isinstance(data, dict) or data.get("kty") not in _MEMBERS or data.get("use", "sig") != "sig":
        return None
    key_id, algorithm = data.get("kid"), data.get("alg")
    members = {name: data.get(name) for name in _MEMBERS[data["kty"]]}
    texts = (*members.values(), "" if key_id is None else key_id, "" if algorithm is None else algorithm)
    if not all(isinstance(text, str) for text in texts) or algorithm not in (None, *ALGORITHMS):
        return None
    try:
        key = _import_key(members)
    except (JoseError, ValueError, TypeError, KeyError):  # the last one for an unknown curve
        return None
    return None if key is None else SigningKey(key, key_id, algorithm)


def _import_key(members: dict[str, Any]) -> RSAKey | ECKey | None:
    if members["kty"] == "EC":
        return ECKey.import_key(members)
    if len(members["e"]) > MOST_EXPONENT_DIGITS or len(members["n"]) > RSA_BITS[-1] // 6 + 4:
        return None
    key = RSAKey.binding.import_public_key(members)  # pyrefly: ignore[missing-attribute]  # typed as its parent
    return RSAKey.import_key(key) if key.key_size in RSA_BITS else None


def verify(token: str, keys: Sequence[SigningKey], expected: Expectation, now_s: int) -> dict[str, Any]:
    """Return the claims of a valid token at the time `now_s`, in seconds since 1970.

    Raises `UnknownSigningKey` if no key fits the token, and `InvalidIdToken` if the token is refused for another
    reason.
    """
    if len(token) > MOST_TOKEN_BYTES:
        raise InvalidIdToken(f"the token is longer than {MOST_TOKEN_BYTES} bytes")
    # Unknown members of the header are ignored (RFC 7515, section 4), but those that it declares critical are not.
    registry = jws.JWSRegistry(algorithms=ALGORITHMS, strict_check_header=False)
    registry.max_header_length, registry.max_payload_length = MOST_HEADER_BYTES, MOST_TOKEN_BYTES
    try:
        key = _key_of(token, keys, registry)
        claims = jwt.decode(token, key, ALGORITHMS, registry).claims
    except (JoseError, ValueError, TypeError, RecursionError) as error:
        raise InvalidIdToken("the signature of the token is not valid") from error
    _check_claims(claims, expected, now_s)
    return claims


def _key_of(token: str, keys: Sequence[SigningKey], registry: jws.JWSRegistry) -> RSAKey | ECKey:
    """Return the key that fits the algorithm and the key id in the header of a token.

    Raises `UnknownSigningKey` if no key fits, and `InvalidIdToken` if several keys fit or the header is not valid.
    """
    header = jws.extract_compact(token.encode("ascii"), registry=registry).headers()
    if not isinstance(header, dict):
        raise InvalidIdToken("the header of the token is not a JSON object")
    algorithm, key_id = header.get("alg"), header.get("kid")
    if algorithm not in ALGORITHMS:
        raise InvalidIdToken("the token is not signed with an accepted algorithm")
    if key_id is not None and not isinstance(key_id, str):
        raise InvalidIdToken("the key id (`kid`) in the header of the token is not a string")
    fitting = [one.key for one in keys if one.fits(algorithm, key_id)]
    if not fitting:
        raise UnknownSigningKey("the token is signed with a key that the provider does not list")
    if len(fitting) > 1:
        raise InvalidIdToken(
            "several keys of the provider fit the token; each key needs a key id (`kid`), which the token must name"
        )
    return fitting[0]


def _check_claims(claims: dict[str, Any], expected: Expectation, now_s: int) -> None:
    registry = jwt.JWTClaimsRegistry(
        now_s,
        expected.leeway_s,
        iss={"essential": True, "value": expected.issuer},
        aud={"essential": True, "value": expected.client_id},
        sub={"essential": True},
        exp={"essential": True},
        iat={"essential": True},
    )
    try:
        registry.validate(claims)
    except ExpiredTokenError:
        raise InvalidIdToken(
            "the token has expired; if it is new, the clocks of this server and of the provider differ"
        ) from None
    except MissingClaimError as error:
        raise InvalidIdToken(f"the token has no claim {error.claim}") from None
    except InvalidClaimError as error:
        raise InvalidIdToken(f"the claim {error.claim} of the token does not have the expected value") from None
    if claims.get("nonce") != expected.nonce:
        raise InvalidIdToken("the claim nonce of the token does not have the expected value")
    audiences = claims["aud"] if isinstance(claims["aud"], list) else [claims["aud"]]
    if ("azp" in claims or len(audiences) > 1) and claims.get("azp") != expected.client_id:
        raise InvalidIdToken("the claim azp of the token does not have the expected value")
    if not _SUBJECT.fullmatch(claims["sub"]):
        raise InvalidIdToken("the claim sub of the token does not consist of 1 to 255 printable ASCII characters")
