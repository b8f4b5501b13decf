"""Login with the identity provider of a team: the person signs in in a browser, and this command gets the token.

The command makes a secret, the verifier, of which the server gets only a hash at first. The server accepts the code
from the browser only together with this verifier. So nobody else can use a code that leaks.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import sys
import time
import webbrowser
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.output import print_message
from marey_client.cli.terminal.secrets import ask_secret

if TYPE_CHECKING:
    from marey_client.marey import Marey

LOOPBACK_ADDRESS = "127.0.0.1"
REQUEST_S = 5.0
"""Longest time in seconds that the browser may take to send its request to this command."""
_DONE = b"<!doctype html><title>Marey</title><p>You are signed in. Return to the terminal; you can close this page.</p>"


class CodeListener(HTTPServer):
    """Local HTTP server at a free port, to which the browser sends the code of one sign-in."""

    def __init__(self) -> None:
        super().__init__((LOOPBACK_ADDRESS, 0), _Handler)
        self.sign_in = ""
        self.code: str | None = None

    @property
    def port(self) -> int:
        """The port of this server."""
        return int(self.server_address[1])

    def wait(self, sign_in: str, seconds: float) -> str:
        """Wait for the code of a sign-in, and return the code. Raises `WrongUsage` if none arrives within `seconds`."""
        self.sign_in = sign_in
        deadline = time.monotonic() + seconds
        while self.code is None and (left := deadline - time.monotonic()) > 0:
            self.timeout = left
            self.handle_request()
        if self.code is None:
            raise WrongUsage(
                "nobody signed in in time; run the command again, or add --paste if the browser runs on another machine"
            )
        return self.code


class _Handler(BaseHTTPRequestHandler):
    server: CodeListener
    timeout = REQUEST_S

    def do_GET(self) -> None:
        """Read the code from the requested address if the address names the sign-in for which this command waits."""
        query = parse_qs(urlsplit(self.path).query)
        sign_in, code = (query.get(name, [""])[0] for name in ("sign_in", "code"))
        expected = self.server.sign_in.encode()
        if not expected or not code or not hmac.compare_digest(sign_in.encode("utf-8", "replace"), expected):
            self.send_error(404)
            return
        self.server.code = code
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Security-Policy", "default-src 'none'")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Length", str(len(_DONE)))
        self.end_headers()
        self.wfile.write(_DONE)

    def log_message(self, format: str, *_arguments: object) -> None:  # noqa: A002
        """Write no log, because the addresses contain codes."""


def sign_in_in_browser(marey: Marey, expires_in_s: int, *, paste: bool) -> str:
    """Let a person sign in in a browser, and return the new token.

    With `paste`, the browser may run on another machine: the browser shows a code, and this command asks the user for
    the code. Otherwise, the browser sends the code to a port of this machine.
    """
    from marey_schemas.sign_ins import BrowserSignInCode, BrowserSignInCreate

    verifier = secrets.token_urlsafe(32)
    challenge = hashlib.sha256(verifier.encode()).hexdigest()
    with CodeListener() as listener:
        port = None if paste else listener.port
        begun = marey.begin_sign_in(BrowserSignInCreate(challenge=challenge, port=port, expires_in_s=expires_in_s))
        if urlsplit(begun.url).scheme not in ("http", "https"):
            raise WrongUsage(
                f"the server sent {begun.url!r} as the address of the sign-in, which does not begin with http:// or "
                "https://; ask an administrator to correct the address of the server"
            )
        print_message(f"sign in at this address, in a browser{'' if paste else ' on this machine'}:\n{begun.url}")
        if paste:
            code = ask_secret("Code that the browser shows")
        else:
            if sys.stderr.isatty():
                webbrowser.open(begun.url)
            code = listener.wait(begun.id, (begun.expires_at - datetime.now(UTC)).total_seconds())
    return marey.finish_sign_in(begun.id, BrowserSignInCode(code=code.strip(), verifier=verifier)).secret
