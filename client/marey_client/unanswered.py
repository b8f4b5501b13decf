"""Explanations for requests without an answer of a Marey server: no answer, or an answer of another program."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator

import httpx

from marey_client.credentials import LOOPBACK
from marey_client.errors import UnexpectedAnswer
from marey_schemas.encoding.codecs import JSON

NOT_MODIFIED = 304
_BEHIND = "a proxy answers there, and the Marey server behind it is not running or not reachable"
_ADVICE = {
    413: "a proxy on the way to the server refuses bodies of this size; raise its limit",
    502: _BEHIND,
    503: _BEHIND,
    504: _BEHIND,
}
"""End of an error text by HTTP status: what another program than Marey means by the status, or what to do."""


def explain_silence(url: str, error: httpx.TransportError) -> str:
    """Return the reason why the server at `url` gave no answer, and what to do."""
    causes = list(_causes(error))
    address = httpx.URL(url)
    if any(isinstance(one, ConnectionRefusedError) for one in causes):
        start = ", or start the server with `marey serve`" if address.host in LOOPBACK else ", and that the server runs"
        return f"no program listens at this address; check the port{start}"
    if any(isinstance(one, socket.gaierror) for one in causes):
        return f"the name {address.host} is unknown in this network; check its spelling"
    for one in causes:
        if isinstance(one, ssl.SSLCertVerificationError):
            return (
                f"its certificate is not trusted: {one.verify_message}; if this is your server, name the file with the "
                "certificate of its authority in the variable SSL_CERT_FILE"
            )
        if isinstance(one, ssl.SSLError):
            return f"the program at this address does not use TLS; try {address.copy_with(scheme='http')}"
    if isinstance(error, httpx.ConnectTimeout):
        plain = f", or, without TLS, write {address.copy_with(scheme='http')}" if address.scheme == "https" else ""
        return f"no connection within 10 s; check the address, the network and the firewall{plain}"
    if isinstance(error, httpx.TimeoutException):
        return "no answer in time"
    if isinstance(error, httpx.RemoteProtocolError | httpx.ReadError | httpx.WriteError):
        tls = "" if address.scheme == "https" else f", or needs the address {address.copy_with(scheme='https')}"
        return f"the connection ended before an answer; the server may have been stopped{tls}"
    named = next((one.strerror for one in causes if isinstance(one, OSError) and one.strerror), None)
    return named or str(error) or type(error).__name__


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def server_of(response: httpx.Response) -> str:
    """Return the address of the server that gave an answer, without a path."""
    return str(response.request.url.copy_with(raw_path=b"/")).rstrip("/")


def media_type_of(response: httpx.Response) -> str:
    """Return the media type of an answer without its parameters."""
    stated: str = response.headers.get("Content-Type", "")
    return stated.partition(";")[0].strip().lower()


def not_of_marey(response: httpx.Response) -> str:
    """Return the message for an answer of another program than Marey, such as a proxy or a web page for signing in."""
    place = response.headers.get("Location")
    what = f"{response.status_code} {response.reason_phrase}{f' with the address {place}' if place else ''}"
    kind = f" ({media_type_of(response)})" if response.headers.get("Content-Type") else ""
    advice = _ADVICE.get(response.status_code, "check the address of the server, and proxies on the way to it")
    return f"{server_of(response)} answered {what}{kind}, which is not an answer of a Marey server; {advice}"


def require_marey(response: httpx.Response) -> None:
    """Raise `UnexpectedAnswer` for a redirection, and for a web page where JSON was requested."""
    page = media_type_of(response) == "text/html" and response.request.headers.get("Accept") == JSON
    if page or (300 <= response.status_code < 400 and response.status_code != NOT_MODIFIED):
        raise UnexpectedAnswer(not_of_marey(response))
