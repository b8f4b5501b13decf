"""One connection for a load test: requests without retries, which take little processor time of the caller."""

from __future__ import annotations

import http.client
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import orjson

from marey_client.credentials import trusted_authorities
from marey_schemas.address import API

NO_ANSWER = "no-answer"
"""Code of a request that got no answer, because the connection broke or the time limit was exceeded."""
TIMEOUT_S = 60.0


class LoadAnswer(NamedTuple):
    """Answer to a request: `status` is 0 if there was none; `code` is the short name of an error, empty otherwise."""

    status: int
    code: str
    document: dict[str, Any]


class LoadConnection:
    """Connection to a server that is kept open. It may be used by one thread at a time.

    Unlike `Transport`, it never repeats a request, because a repeated request would hide an error from the measurement.
    """

    def __init__(self, url: str, token: str) -> None:
        parts = urlsplit(url)
        self._path = f"{parts.path.rstrip('/')}{API}"
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        if parts.scheme == "https":
            self._connection: http.client.HTTPConnection = http.client.HTTPSConnection(
                parts.hostname or "", parts.port, timeout=TIMEOUT_S, context=trusted_authorities()
            )
        else:
            self._connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=TIMEOUT_S)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def post(
        self,
        path: str,
        document: Mapping[str, Any],
        *,
        token: str | None = None,
        headers: Mapping[str, str] = MappingProxyType({}),
    ) -> LoadAnswer:
        """Send a JSON document by POST; a `token` replaces the connection's token for this request."""
        sent = {**self._headers, **headers}
        if token is not None:
            sent["Authorization"] = f"Bearer {token}"
        try:
            self._connection.request("POST", self._path + path, orjson.dumps(document), sent)
            answer = self._connection.getresponse()
            body = answer.read()
        except (OSError, http.client.HTTPException):
            self._connection.close()
            return LoadAnswer(0, NO_ANSWER, {})
        return LoadAnswer(answer.status, *_read(answer.status, body))

    def send_only(self, path: str, document: Mapping[str, Any]) -> None:
        """Send a JSON document by POST and do not read the answer; the caller closes the connection."""
        self._connection.request("POST", self._path + path, orjson.dumps(document), self._headers)


@contextmanager
def connection(url: str, token: str) -> Iterator[LoadConnection]:
    """Open a connection, and close it at the end of the `with` block."""
    caller = LoadConnection(url, token)
    try:
        yield caller
    finally:
        caller.close()


def _read(status: int, body: bytes) -> tuple[str, dict[str, Any]]:
    """Return error code and document of an answer; the code is empty without an error.

    An answer whose body is not a JSON object has the code `http-` followed by the status.
    """
    try:
        document = orjson.loads(body) if body else {}
    except orjson.JSONDecodeError:
        document = None
    if not isinstance(document, dict):
        return f"http-{status}", {}
    return ("" if status < 400 else str(document.get("code", f"http-{status}"))), document
