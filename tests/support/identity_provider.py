"""An identity provider on this machine: OpenID Connect with keys of its own, and faults on demand."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any
from urllib.parse import urlencode

from joserfc import jws
from joserfc.jwk import ECKey, RSAKey
from tests.support.patience import PATIENCE_S
from tornado.httpserver import HTTPServer
from tornado.testing import bind_unused_port
from tornado.web import Application, RequestHandler

CLIENT, SECRET = "marey", "s3cret: with & odd characters"


@cache
def rsa_key(key_id: str) -> RSAKey:
    """Return the private RSA key with an id; it is the same for the whole test run."""
    return RSAKey.generate_key(2048, {"kid": key_id, "use": "sig"})


@cache
def ec_key(key_id: str) -> ECKey:
    """Return the private key on the curve P-256 with an id."""
    return ECKey.generate_key("P-256", {"kid": key_id, "alg": "ES256"})


def public_keys(*keys: RSAKey | ECKey) -> dict[str, Any]:
    """Return a JSON Web Key Set, which also contains a key of a type that the server does not use."""
    return {"keys": [{"kty": "oct", "k": "c2VjcmV0", "kid": "shared"}, *(key.as_dict(private=False) for key in keys)]}


@dataclass
class FakeProvider:
    """State of the provider: who is signed in, how its tokens differ from valid ones, and what it answers."""

    url: str = ""
    claims: dict[str, Any] = field(default_factory=lambda: {"sub": "sub-ada", "preferred_username": "Ada@lab.example"})
    key: RSAKey | ECKey = field(default_factory=lambda: ec_key("first"))
    listed: list[RSAKey | ECKey] = field(default_factory=lambda: [ec_key("first")])
    issued: dict[str, dict[str, str]] = field(default_factory=dict)
    """By authorization code, the query of the request to sign in."""
    requests: list[str] = field(default_factory=list)
    """The paths of the requests."""
    fault: str = ""
    """How the addresses for programs fail: `status`, `redirect`, `huge`, `slow`, `text`, `list` or `issuer`."""
    error: str = ""
    """Error with which a browser is sent back."""
    released: threading.Event = field(default_factory=threading.Event)
    """Set when slow answers may continue."""

    def id_token(self, nonce: str, **changed: Any) -> str:
        now_s = int(time.time())
        claims = {"iss": self.url, "aud": CLIENT, "iat": now_s, "exp": now_s + 300, "nonce": nonce, **self.claims}
        header = {"alg": "RS256" if isinstance(self.key, RSAKey) else "ES256", "kid": self.key.kid}
        payload = json.dumps(claims | changed).encode()  # in ASCII, so that claims may contain halves of surrogates
        return jws.serialize_compact(header, payload, self.key)


class _Handler(RequestHandler):
    def initialize(self, provider: FakeProvider) -> None:
        self.provider = provider

    async def prepare(self) -> None:
        self.provider.requests.append(self.request.path)
        if self.request.path == "/authorize" or not self.provider.fault:
            return
        match self.provider.fault:
            case "status":
                self.set_status(500)
            case "redirect":
                self.redirect("https://127.0.0.1/elsewhere")
                return
            case "huge":
                self.write(b'{"x": "' + b"x" * 2**20 + b'"}')
            case "slow":
                while not self.provider.released.is_set():
                    await asyncio.sleep(0.01)
            case "text":
                self.write("<html>")
            case "list":
                self.write("[1]")
            case "issuer":
                self.write({"issuer": "https://elsewhere.example"})
        self.finish()


class _Discovery(_Handler):
    def get(self) -> None:
        url = self.provider.url
        self.write({
            "issuer": url,
            "authorization_endpoint": f"{url}/authorize?tenant=lab",
            "token_endpoint": f"{url}/token",
            "jwks_uri": f"{url}/keys",
        })  # fmt: skip


class _Keys(_Handler):
    def get(self) -> None:
        self.write(public_keys(*self.provider.listed))


class _Authorize(_Handler):
    def get(self) -> None:
        query = {name: self.get_query_argument(name) for name in self.request.query_arguments}
        assert (query["client_id"], query["response_type"], query["tenant"]) == (CLIENT, "code", "lab")
        code = secrets.token_hex(8)
        self.provider.issued[code] = query
        answer = {"error": self.provider.error} if self.provider.error else {"code": code, "session_state": "x"}
        self.redirect(f"{query['redirect_uri']}?{urlencode({'state': query['state'], **answer})}")


class _Token(_Handler):
    def post(self) -> None:
        form = {name: self.get_body_argument(name) for name in self.request.body_arguments}
        asked = self.provider.issued.pop(form["code"], None)
        digest = hashlib.sha256(form["code_verifier"].encode()).digest()
        challenge = base64.urlsafe_b64encode(digest).rstrip(b"=").decode()
        quoted = urlencode({"": SECRET})[1:]
        expected = "Basic " + base64.b64encode(f"{CLIENT}:{quoted}".encode()).decode()
        if (
            asked is None
            or asked["code_challenge"] != challenge
            or asked["redirect_uri"] != form["redirect_uri"]
            or self.request.headers.get("Authorization") != expected
        ):
            self.set_status(400)
            self.write({"error": "invalid_grant"})
            return
        self.write(json.dumps({"access_token": "unused", "id_token": self.provider.id_token(asked["nonce"])}))


@contextmanager
def provider_running() -> Iterator[FakeProvider]:
    """Run an identity provider in a thread while the `with` block runs."""
    provider, loop = FakeProvider(), asyncio.new_event_loop()
    routes = {
        "/.well-known/openid-configuration": _Discovery,
        "/keys": _Keys,
        "/authorize": _Authorize,
        "/token": _Token,
    }
    listener, port = bind_unused_port()
    provider.url = f"http://127.0.0.1:{port}"
    ready, stop = threading.Event(), asyncio.Event()

    async def main() -> None:
        server = HTTPServer(Application([(path, handler, {"provider": provider}) for path, handler in routes.items()]))
        server.add_sockets([listener])
        ready.set()
        await stop.wait()
        server.stop()
        await server.close_all_connections()

    thread = threading.Thread(target=loop.run_until_complete, args=(main(),), name="marey-test-provider")
    thread.start()
    assert ready.wait(PATIENCE_S)
    try:
        yield provider
    finally:
        provider.released.set()
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE_S)
        loop.close()
