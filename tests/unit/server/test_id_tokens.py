"""ID tokens: everything that must not pass for a valid token, and the keys that are used."""

from __future__ import annotations

import base64
import hmac
import json
from collections.abc import Callable
from typing import Any

import pytest
from joserfc import jws, jwt
from joserfc.jwk import RSAKey
from tests.support.identity_provider import ec_key, public_keys, rsa_key

from marey_server.access.id_tokens import (
    ALGORITHMS,
    MOST_HEADER_BYTES,
    Expectation,
    InvalidIdToken,
    SigningKey,
    UnknownSigningKey,
    read_keys,
    verify,
)

NOW_S = 1_800_000_000
EXPECTED = Expectation("https://login.example", "marey", "n0nce", leeway_s=60)
VALID = {"iss": EXPECTED.issuer, "aud": "marey", "sub": "ada", "nonce": "n0nce", "iat": NOW_S, "exp": NOW_S + 300}
RSA, EC = rsa_key("first"), ec_key("ec")
KEYS = read_keys(public_keys(RSA, EC))


def signed(header: dict[str, Any] | None = None, key: Any = RSA, **claims: Any) -> str:
    """Return a signed token; a claim that is None is left out."""
    every = {name: value for name, value in (VALID | claims).items() if value is not None}
    registry = jws.JWSRegistry(algorithms=ALGORITHMS, strict_check_header=False)
    registry.max_header_length = MOST_HEADER_BYTES
    algorithm = "RS256" if isinstance(key, RSAKey) else "ES256"
    return jwt.encode({"alg": algorithm, "kid": key.kid, **(header or {})}, every, key, ALGORITHMS, registry)


def unsigned(header: Any, claims: Any = VALID, signature: str = "") -> str:
    """Return a token with any header, claims and signature."""
    return ".".join((encoded(header), encoded(claims), signature))


def encoded(value: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(value).encode()).rstrip(b"=").decode()


def signed_with_public_key(algorithm: str) -> str:
    """Return a token whose HMAC has the public key of the provider as its secret."""
    start = unsigned({"alg": algorithm, "kid": "first"}).rstrip(".")
    digest = hmac.digest(RSA.as_pem(private=False), start.encode(), "sha256")
    return f"{start}.{base64.urlsafe_b64encode(digest).rstrip(b'=').decode()}"


def with_other_payload() -> str:
    header, _, signature = signed().split(".")
    return ".".join((header, encoded(VALID | {"sub": "eve"}), signature))


@pytest.mark.parametrize(
    ("change", "header"),
    [
        ({}, {}),
        ({"aud": ["marey"]}, {}),
        ({"aud": ["marey", "other"], "azp": "marey"}, {}),
        ({"exp": NOW_S - 59}, {}),
        ({"iat": NOW_S + 60}, {}),
        ({"sub": "x" * 255}, {}),
        ({}, {"alg": "PS256"}),
        ({}, {"x-unknown": "ignored"}),
    ],
)
def test_valid_tokens_pass(change: dict[str, Any], header: dict[str, Any]) -> None:
    assert verify(signed(header, **change), KEYS, EXPECTED, NOW_S)["nonce"] == "n0nce"


def test_a_token_without_a_key_id_passes_if_only_one_key_fits() -> None:
    bare = jwt.encode({"alg": "ES256"}, VALID, EC)
    assert verify(bare, KEYS, EXPECTED, NOW_S)["sub"] == "ada"
    two = read_keys(public_keys(EC, ec_key("other")))
    with pytest.raises(InvalidIdToken, match="several keys of the provider fit the token"):
        verify(bare, two, EXPECTED, NOW_S)


WRONG_CLAIMS: list[tuple[dict[str, Any], str]] = [
    ({"aud": "other"}, "claim aud"),
    ({"aud": None}, "no claim aud"),
    ({"aud": []}, "claim aud"),
    ({"aud": {"marey": 1}}, "claim aud"),
    ({"aud": ["marey", "other"]}, "claim azp"),
    ({"aud": ["marey", 7]}, "claim aud"),
    ({"azp": "other"}, "claim azp"),
    ({"iss": "https://login.example/"}, "claim iss"),
    ({"iss": None}, "no claim iss"),
    ({"iss": [EXPECTED.issuer]}, "claim iss"),
    ({"nonce": "another"}, "claim nonce"),
    ({"nonce": None}, "claim nonce"),
    ({"nonce": ["n0nce"]}, "claim nonce"),
    ({"exp": NOW_S - 60}, "expired"),
    ({"exp": None}, "no claim exp"),
    ({"exp": True}, "claim exp"),
    ({"exp": str(NOW_S + 300)}, "claim exp"),
    ({"exp": float("nan")}, "claim exp"),
    ({"iat": NOW_S + 61}, "claim iat"),
    ({"iat": None}, "no claim iat"),
    ({"nbf": NOW_S + 61}, "claim nbf"),
    ({"sub": None}, "no claim sub"),
    ({"sub": ""}, "claim sub"),
    ({"sub": 7}, "claim sub"),
    ({"sub": "x" * 256}, "claim sub"),
    ({"sub": "a\u0000b"}, "claim sub"),
    ({"sub": "ad\u00e4"}, "claim sub"),
]


@pytest.mark.parametrize(("change", "reason"), WRONG_CLAIMS)
def test_wrong_claims_are_refused(change: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidIdToken, match=reason):
        verify(signed(**change), KEYS, EXPECTED, NOW_S)


FORGED: list[tuple[str, Callable[[], str], str]] = [
    ("no algorithm", lambda: unsigned({"alg": "none"}), "accepted algorithm"),
    ("no algorithm, written otherwise", lambda: unsigned({"alg": "nOnE", "kid": "first"}), "accepted algorithm"),
    ("no alg", lambda: unsigned({"kid": "first"}), "signature"),
    ("alg is a list", lambda: unsigned({"alg": ["RS256"]}), "accepted algorithm"),
    ("public key as HMAC secret", lambda: signed_with_public_key("HS256"), "accepted algorithm"),
    ("HMAC said to be RSA", lambda: signed_with_public_key("RS256"), "signature"),
    ("other claims", with_other_payload, "signature"),
    ("no signature", lambda: unsigned({"alg": "RS256", "kid": "first"}), "signature"),
    ("key in the header", lambda: signed({"jwk": rsa_key("evil").as_dict(private=False)}, rsa_key("evil")), "list"),
    ("known id of another key", lambda: signed({"kid": "first"}, rsa_key("evil")), "signature"),
    ("address of keys in the header", lambda: signed({"jku": "http://e.example"}, rsa_key("evil")), "list"),
    ("RSA key for ECDSA", lambda: unsigned({"alg": "ES256", "kid": "first"}, signature="AA"), "list"),
    ("another curve", lambda: unsigned({"alg": "ES384", "kid": "ec"}, signature="AA"), "signature|list"),
    ("id that is a path", lambda: signed({"kid": "../../dev/null"}), "list"),
    ("id that is a number", lambda: unsigned({"alg": "RS256", "kid": 1}, signature="AA"), "not a string"),
    ("id of the shared secret", lambda: signed({"kid": "shared"}), "list"),
    ("unknown critical header", lambda: unsigned({"alg": "RS256", "kid": "first", "crit": ["x"], "x": 1}), "signature"),
    ("header is a list", lambda: unsigned(["alg"]), "header"),
    ("header is a text", lambda: unsigned("alg"), "header"),
    ("deep header", lambda: ".".join((encoded(json.loads("[" * 100 + "]" * 100)), encoded(VALID), "AA")), "signature"),
    ("claims are a list", lambda: jwt_of([1]), "signature"),
    ("claims are no JSON", lambda: ".".join((encoded({"alg": "RS256", "kid": "first"}), "!!!", "AA")), "signature"),
    ("encrypted", lambda: "a.b.c.d.e", "signature"),
    ("two parts", lambda: "a.b", "signature"),
    ("empty", lambda: "", "signature"),
    ("not ASCII", lambda: "\u00e4.b.c", "signature"),
    ("longer than allowed", lambda: signed(padding="x" * 40_000), "longer"),
]


def jwt_of(claims: Any) -> str:
    return jws.serialize_compact({"alg": "RS256", "kid": "first"}, json.dumps(claims), RSA)


@pytest.mark.parametrize(("forge", "reason"), [one[1:] for one in FORGED], ids=[one[0] for one in FORGED])
def test_forged_tokens_are_refused(forge: Callable[[], str], reason: str) -> None:
    with pytest.raises(InvalidIdToken, match=reason):
        verify(forge(), KEYS, EXPECTED, NOW_S)


def test_a_token_with_an_unlisted_key_is_told_apart_because_keys_change() -> None:
    with pytest.raises(UnknownSigningKey):
        verify(signed(key=rsa_key("evil")), KEYS, EXPECTED, NOW_S)


def test_only_usable_public_keys_are_taken_from_the_list() -> None:
    public = RSA.as_dict(private=False)
    unusable: list[Any] = [
        7,
        {},
        {"kty": "RSA"},
        {**public, "use": "enc"},
        {**public, "alg": "HS256"},
        {**public, "kid": 7},
        {**public, "e": "A" * 9},
        {**public, "n": "A" * 3000},
        {**public, "n": "AQAB"},
        {**public, "n": "\u00e4"},
        {"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA"},
        {"kty": "EC", "crv": "P-0", "x": "AA", "y": "AA"},
    ]
    kept = read_keys({"keys": [*unusable, RSA.as_dict(private=True)]})
    assert [(one.key_id, one.key.is_private) for one in kept] == [("first", False)]
    wrongs: list[dict[str, Any]] = [{}, {"keys": {}}, {"keys": unusable}, {"keys": [public] * 65}]
    for wrong in wrongs:
        with pytest.raises(ValueError, match=r"member `keys` of the key set is not|no key of the set"):
            read_keys(wrong)


def test_a_key_that_names_an_algorithm_is_for_this_algorithm_only() -> None:
    bound = (SigningKey(KEYS[0].key, "first", "RS512"),)
    with pytest.raises(UnknownSigningKey):
        verify(signed(), bound, EXPECTED, NOW_S)
