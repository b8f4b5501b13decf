"""Requests to the URLs of webhooks.

A host name is resolved for each attempt, and the connection goes to the address that was checked. So a name cannot lead
to a private network, even if its address changes after the check. Redirects are not followed, and the body of the
answer is not used. So errors and logs contain neither the target of a redirect nor the body.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.metadata import version
from typing import Any

from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.netutil import Resolver
from tornado.simple_httpclient import HTTPStreamClosedError, HTTPTimeoutError, SimpleAsyncHTTPClient

from marey_schemas.sizes import KIB
from marey_server.access.network_addresses import Network, may_connect
from marey_server.access.webhook_signatures import signed_headers
from marey_server.store.webhooks.outbox import Delivery, DeliveryResult, Destination

TIMEOUT_S = 10.0
MOST_ANSWER_BYTES = 64 * KIB
MOST_AT_ONCE = 64
"""Greatest number of requests under way."""
MOST_OF_ONE_USER = 4
"""Greatest number of requests under way to webhooks of one user, so that no user can occupy all places."""
RESOLVERS = 16
"""Number of threads that resolve host names, because a slow name server blocks a thread."""
AGENT = f"marey/{version('marey')}"
_FIRST_FAILURE = 300


class AddressRefused(OSError):
    """Error of a host that has no address to which the server may connect."""


class CheckedResolver(Resolver):
    """Resolver of host names that returns only addresses to which the server may connect.

    Parameters
    ----------
    networks : networks that are allowed although they are not public
    """

    def initialize(self, networks: Sequence[Network]) -> None:
        """Store the networks, and create the threads that resolve names."""
        self._networks = tuple(networks)
        self._threads = ThreadPoolExecutor(RESOLVERS, thread_name_prefix="webhook-names")

    async def resolve(
        self, host: str, port: int, family: socket.AddressFamily = socket.AF_UNSPEC
    ) -> list[tuple[int, Any]]:
        """Return the permitted addresses of a host, each with its family.

        Raises `AddressRefused` if no address of the host is permitted, and `OSError` if the name cannot be resolved.
        """
        loop = asyncio.get_running_loop()
        found = await loop.run_in_executor(self._threads, _look_up, host, port, family)
        permitted = [(kind, address) for kind, address in found if may_connect(address[0], self._networks)]
        if not permitted:
            raise AddressRefused("the host has no public address")
        return permitted

    def close(self) -> None:
        """End the threads as soon as they are idle."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _look_up(host: str, port: int, family: socket.AddressFamily) -> list[tuple[int, Any]]:
    found = socket.getaddrinfo(host, port, family, socket.SOCK_STREAM)
    return list(dict.fromkeys((int(kind), address) for kind, _type, _protocol, _name, address in found))


class Sender:
    """Client that sends deliveries; it must be created and used on one event loop."""

    def __init__(self, networks: Sequence[Network]) -> None:
        self._resolver = CheckedResolver(networks=networks)
        self._client = SimpleAsyncHTTPClient(
            force_instance=True,
            resolver=self._resolver,
            max_clients=MOST_AT_ONCE,
            max_body_size=MOST_ANSWER_BYTES,
            max_header_size=MOST_ANSWER_BYTES,
        )

    async def send(self, destination: Destination, delivery: Delivery) -> DeliveryResult:
        """Send a delivery once, and return the result. An answer with a status from 200 to 299 is a success."""
        body = delivery.body.encode()
        headers = signed_headers(destination.secrets, delivery.id, delivery.kind, int(time.time()), body)
        first_lines: list[str] = []
        request = HTTPRequest(
            destination.url,
            method="POST",
            headers={"Content-Type": "application/json", "User-Agent": AGENT, **headers},
            body=body,
            connect_timeout=TIMEOUT_S,
            request_timeout=TIMEOUT_S,
            follow_redirects=False,
            decompress_response=False,
            header_callback=lambda line: first_lines.append(line) if line.startswith("HTTP/") else None,
        )
        error: Exception | None = None
        try:
            await self._client.fetch(request, raise_error=False)
        except (HTTPClientError, OSError, ValueError) as failure:
            error = failure
        status = _status(first_lines)
        if status is None:
            return DeliveryResult(None, _sentence(error))
        return DeliveryResult(status, None if status < _FIRST_FAILURE else _refusal(status))

    def close(self) -> None:
        """Close the connections, and end the threads."""
        self._client.close()
        self._resolver.close()


def _status(first_lines: Sequence[str]) -> int | None:
    """Return the status of an answer, or None if there is no answer.

    The last of the status lines has this status; earlier lines belong to interim answers, such as 100 Continue.
    """
    with suppress(IndexError, ValueError):
        return int(first_lines[-1].split()[1])
    return None


def _refusal(status: int) -> str:
    redirected = "; redirects are not followed" if status < 400 else ""
    return f"the answer has the status {status}{redirected}"


def _sentence(error: Exception | None) -> str:
    """Return the reason of a failure in words, without any text that the receiver has sent."""
    if isinstance(error, HTTPTimeoutError):
        return f"no answer within {TIMEOUT_S:g} s"
    if isinstance(error, AddressRefused):
        return "the host has no public address, and none in the networks of the setting `webhook_networks`"
    if isinstance(error, socket.gaierror):
        return "the name of the host cannot be resolved"
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the certificate is not valid: {error.verify_message}"[:250]
    if isinstance(error, ssl.SSLError):
        return "no TLS connection could be made"
    if isinstance(error, ConnectionRefusedError):
        return "the connection was refused"
    if isinstance(error, HTTPStreamClosedError | HTTPClientError) or error is None:
        return "the connection was closed before a complete answer"
    return "the host cannot be reached"
