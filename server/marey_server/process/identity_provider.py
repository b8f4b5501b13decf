"""Requests to the identity provider of the team, which signs people in (OpenID Connect, authorization code flow).

The answers of the provider have limits of time and size, and redirects are not followed. Its discovery document and its
keys are remembered for an hour. A token that is signed with an unknown key makes the server read the keys again, but at
most every `REFETCH_S` seconds, so that forged tokens cause few requests.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import logging
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NoReturn, TypeVar
from urllib.parse import quote_plus, urlencode

import httpx

from marey_schemas.address import API
from marey_schemas.sign_ins import CALLBACK_PATH
from marey_schemas.sizes import KIB
from marey_server.access.id_tokens import (
    Expectation,
    InvalidIdToken,
    Person,
    SigningKey,
    UnknownSigningKey,
    read_keys,
    verify,
)
from marey_server.access.network_addresses import is_protected
from marey_server.errors import ForbiddenProblem, UnauthenticatedProblem, UnavailableProblem
from marey_server.process.secret_files import read_secret
from marey_server.process.setting_groups.identity_settings import IdentitySettings

PROVIDER_TIMEOUT_S = 10.0
MOST_ANSWER_BYTES = 256 * KIB
KEPT_S = 3600.0
REFETCH_S = 30.0
FAILURE_KEPT_S = 3.0
"""Seconds for which a failure to read a document is remembered, so that a provider that is down costs few requests."""
MOST_AT_ONCE = 16
"""Greatest number of codes that are redeemed at the same time; further sign-ins are answered with 503."""

T = TypeVar("T")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Endpoints:
    """Facts from the discovery document of a provider.

    `authorization`, `token` and `keys` are addresses. `secret_in_body` is true if the server must send its client
    secret in the body of a request and not in a header.
    """

    authorization: str
    token: str
    keys: str
    secret_in_body: bool
    names_issuer: bool
    """True if the provider always sends its issuer (parameter `iss`, RFC 9207) when it sends a browser back."""


class CachedDocument(Generic[T]):
    """Cached document of the provider, read when it is first needed. Concurrent requests cause a single read."""

    def __init__(self, load: Callable[[], Awaitable[T]]) -> None:
        self._load = load
        self._lock = asyncio.Lock()
        self._loaded: tuple[float, T] | None = None
        self._failed: tuple[float, str] | None = None

    async def get(self, most_age_s: float = KEPT_S) -> T:
        """Return the document; read it again if the cached one is older than `most_age_s` seconds.

        Raises `UnavailableProblem` if the document cannot be read.
        """
        async with self._lock:
            now_s = time.monotonic()
            if self._loaded is not None and now_s - self._loaded[0] <= most_age_s:
                return self._loaded[1]
            if self._failed is not None and now_s - self._failed[0] <= FAILURE_KEPT_S:
                raise provider_unavailable(self._failed[1])
            try:
                self._loaded = time.monotonic(), await self._load()
            except UnavailableProblem as error:
                self._failed = time.monotonic(), error.detail
                raise
            return self._loaded[1]


def provider_unavailable(detail: str) -> UnavailableProblem:
    """Return the error for an identity provider that does not answer, or answers wrongly; `detail` is the reason."""
    return UnavailableProblem(detail, code="identity-provider-unavailable")


class IdentityProvider:
    """Client of one identity provider; all its methods must be called on the same event loop."""

    def __init__(self, settings: IdentitySettings) -> None:
        assert settings.oidc_issuer is not None
        self.issuer = settings.oidc_issuer
        self._settings = settings
        self._endpoints = CachedDocument(self._discover)
        self._keys = CachedDocument(self._fetch_keys)
        self._places = asyncio.Semaphore(MOST_AT_ONCE)

    @property
    def redirect_uri(self) -> str:
        """The address to which the provider sends browsers back; it must be registered at the provider."""
        return f"{(self._settings.public_url or '').rstrip('/')}{API}{CALLBACK_PATH}"

    async def check(self) -> None:
        """Read the discovery document and the keys. Raises `UnavailableProblem` if one of them cannot be used."""
        await self._endpoints.get()
        await self._keys.get()

    async def authorization_url(self, state: str, nonce: str, verifier: str) -> str:
        """Return the address at the provider to which the server sends a browser, so that the person signs in.

        `state`, `nonce` and `verifier` belong to this sign-in (OpenID Connect, PKCE). Raises `UnavailableProblem` if
        the provider's discovery document cannot be read.
        """
        digest = hashlib.sha256(verifier.encode()).digest()
        endpoint = (await self._endpoints.get()).authorization
        query = {
            "response_type": "code",
            "client_id": self._settings.oidc_client_id or "",
            "redirect_uri": self.redirect_uri,
            "scope": " ".join(self._settings.oidc_scopes),
            "state": state,
            "nonce": nonce,
            "code_challenge": base64.urlsafe_b64encode(digest).rstrip(b"=").decode(),
            "code_challenge_method": "S256",
        }
        return f"{endpoint}{'&' if '?' in endpoint else '?'}{urlencode(query)}"

    async def identify(self, code: str, issuer: str | None, nonce: str, verifier: str) -> Person:
        """Redeem an authorization code for an ID token, and return the person whom the token names.

        `issuer` is the issuer that the provider gave when it sent the browser back, if any. Raises
        `UnauthenticatedProblem` if the code or the token is not valid, `ForbiddenProblem` if the person may not sign
        in, and `UnavailableProblem` if the provider does not answer as it should, or too many people sign in.
        """
        if self._places.locked():
            raise provider_unavailable("Too many people sign in at the moment; try again in a few seconds.")
        async with self._places:
            endpoints = await self._endpoints.get()
            if issuer != self.issuer and (issuer is not None or endpoints.names_issuer):
                raise _refused("The answer came from another identity provider than that of this server.")
            token = await self._redeem(endpoints, code, verifier)
            expected = Expectation(
                self.issuer, self._settings.oidc_client_id or "", nonce, self._settings.oidc_leeway_s
            )
            try:
                claims = await self._verify(token, expected)
            except InvalidIdToken as error:
                log.warning("an ID token was refused: %s", error)
                raise _refused(f"The identity provider sent a token that is not valid: {error}.") from None
        return self._person_in(claims)

    async def _verify(self, token: str, expected: Expectation) -> dict[str, Any]:
        now_s = int(time.time())
        try:
            return verify(token, await self._keys.get(), expected, now_s)
        except UnknownSigningKey:  # perhaps the provider has new keys
            return verify(token, await self._keys.get(REFETCH_S), expected, now_s)

    def _person_in(self, claims: Mapping[str, Any]) -> Person:
        settings = self._settings
        if settings.oidc_allowed_claim is not None:
            found = claims.get(settings.oidc_allowed_claim)
            if not set(settings.oidc_allowed_values) & {
                one for one in (found if isinstance(found, list) else [found]) if isinstance(one, str)
            }:
                raise ForbiddenProblem(
                    "You are in none of the groups or domains whose people may sign in here; ask an administrator.",
                    code="not-in-allowed-group",
                )
        name, shown = claims.get(settings.oidc_name_claim), claims.get("name")
        return Person(
            self.issuer,
            claims["sub"],
            name if isinstance(name, str) else None,
            _storable(shown)[:255] or None if isinstance(shown, str) else None,
        )

    # -- requests -----------------------------------------------------------------------------------------------------

    async def _discover(self) -> Endpoints:
        address = f"{self.issuer.rstrip('/')}/.well-known/openid-configuration"
        document = await self._fetch("discovery document", "GET", address)
        if document.get("issuer") != self.issuer:
            _fail("discovery document", f"it names the issuer {document.get('issuer')!r:.200}, not {self.issuer!r}")
        urls = [document.get(name) for name in ("authorization_endpoint", "token_endpoint", "jwks_uri")]
        for url in urls:
            plain = isinstance(url, str) and url.startswith("http:") and not self.issuer.startswith("http:")
            if not isinstance(url, str) or plain or not is_protected(url):
                _fail("discovery document", "an address in it is missing or does not begin with https://")
        methods = document.get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
        in_body = isinstance(methods, list) and "client_secret_basic" not in methods
        names_issuer = document.get("authorization_response_iss_parameter_supported") is True
        authorization, token, keys = map(str, urls)
        return Endpoints(authorization, token, keys, in_body, names_issuer)

    async def _fetch_keys(self) -> tuple[SigningKey, ...]:
        document = await self._fetch("key set", "GET", (await self._endpoints.get()).keys)
        try:
            return read_keys(document)
        except ValueError as error:
            _fail("key set", str(error))

    async def _redeem(self, endpoints: Endpoints, code: str, verifier: str) -> str:
        """Redeem an authorization code, and return the ID token as text; the caller must verify the token."""
        form = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": self.redirect_uri,
            "code_verifier": verifier,
        }
        headers = {}
        client_id, file = self._settings.oidc_client_id or "", self._settings.oidc_client_secret_file
        secret = "" if file is None else _secret_in(file)
        if secret and not endpoints.secret_in_body:
            pair = f"{quote_plus(client_id)}:{quote_plus(secret)}"
            headers["Authorization"] = f"Basic {base64.b64encode(pair.encode()).decode()}"
        else:
            form |= {"client_id": client_id} | ({"client_secret": secret} if secret else {})
        document = await self._fetch("answer with the ID token", "POST", endpoints.token, headers, form)
        token = document.get("id_token")
        if not isinstance(token, str) or not token.isascii():
            raise _refused("The identity provider sent no ID token.")
        return token

    @cached_property
    def _certificates(self) -> ssl.SSLContext:
        """The trusted certificates: those of the system, or of the variables SSL_CERT_FILE and SSL_CERT_DIR."""
        return ssl.create_default_context()

    async def _fetch(
        self, what: str, method: str, url: str, headers: Mapping[str, str] | None = None, form: Any = None
    ) -> dict[str, Any]:
        """Send a request to the provider, and return the JSON object in its answer.

        `what` names the answer in errors. Raises `UnauthenticatedProblem` if the provider refuses the authorization
        code, and `UnavailableProblem` for every other failure.
        """
        sent = {"Accept": "application/json", "Accept-Encoding": "identity", **(headers or {})}
        try:
            async with (
                asyncio.timeout(PROVIDER_TIMEOUT_S),
                httpx.AsyncClient(verify=self._certificates, timeout=PROVIDER_TIMEOUT_S, trust_env=False) as client,
                client.stream(method, url, headers=sent, data=form) as answer,
            ):
                body = await _read(what, answer)
        except (TimeoutError, httpx.TimeoutException):
            _fail(what, f"it did not come within {PROVIDER_TIMEOUT_S:g} s")
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            log.warning("the %s of the identity provider at %s cannot be read: %r", what, url, error)
            _fail(what, "the provider cannot be reached")
        try:
            document = json.loads(body)
        except (ValueError, RecursionError):
            _fail(what, "it is not JSON")
        if not isinstance(document, dict):
            _fail(what, "it is not a JSON object")
        if answer.status_code == 400 and form is not None and document.get("error") == "invalid_grant":
            raise _refused("The identity provider did not accept the sign-in; it may have taken too long.")
        if answer.status_code != 200:
            _fail(what, f"the answer has the status {answer.status_code}: {str(document.get('error', ''))[:100]!r}")
        return document


async def _read(what: str, answer: httpx.Response) -> bytes:
    """Return the body of an answer. Raises `UnavailableProblem` if the body is compressed or too long."""
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        _fail(what, "it is compressed, although this was not requested")
    body = bytearray()
    async for piece in answer.aiter_raw():
        body += piece
        if len(body) > MOST_ANSWER_BYTES:
            _fail(what, f"it is longer than {MOST_ANSWER_BYTES} bytes")
    return bytes(body)


def _storable(text: str) -> str:
    """Return a text without the characters that no database stores: NUL, and halves of surrogate pairs."""
    return text.encode(errors="ignore").decode().replace("\0", "")


def _secret_in(file: Any) -> str:
    try:
        return read_secret(file)
    except ValueError as error:
        log.error("the setting oidc_client_secret_file: %s", error)
        raise provider_unavailable(
            "The server cannot read the file that the setting oidc_client_secret_file names; ask an administrator."
        ) from None


def _fail(what: str, reason: str) -> NoReturn:
    raise provider_unavailable(
        f"The {what} of the identity provider cannot be used: {reason}. Try again in a minute; if that fails, an "
        "administrator finds out more with `marey doctor`."
    )


def _refused(detail: str) -> UnauthenticatedProblem:
    return UnauthenticatedProblem(f"{detail} Run the command again.", code="sign-in-refused")
