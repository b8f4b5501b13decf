"""Requests to the server for shell completion: with the saved token, few at a time, and for less than a second.

Uses `http.client` instead of the SDK, because loading the SDK takes longer than all requests together.
"""

from __future__ import annotations

import http.client
import json
import os
import ssl
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode, urlsplit

from marey_schemas.address import API, SERVER_VARIABLES

if TYPE_CHECKING:
    from marey_client.credentials import Credential

PATIENCE_S = 0.8
"""Longest time in seconds for all requests after one press of Tab, without the program's start (about 0.4 s)."""
LISTS_AT_ONCE = 4
MOST_ENTRIES = 200
"""Greatest number of entries that one request asks for."""
MOST_PAGES = 50
MOST_ANSWER_BYTES = 1 << 22


@dataclass(frozen=True)
class ListRequest:
    """Request for a list of the server: its path below the root of the REST API, and its query parameters."""

    path: str
    query: Mapping[str, str | int] = field(default_factory=dict)
    whole: bool = False
    """Whether all pages of the list are read until the deadline; otherwise, only the first page is read."""

    @classmethod
    def of(cls, *names: str, **query: str | int | None) -> ListRequest:
        """Return the request for a path, given by its names; query parameters that are None are left out."""
        path = "/".join(quote(name, safe="") for name in names)
        asked = {"limit": MOST_ENTRIES, **query}
        return cls(f"/{path}", {key: value for key, value in asked.items() if value is not None})


@dataclass(frozen=True)
class ListClient:
    """Reader of lists of the server during one completion, until a deadline."""

    credential: Credential
    until: float
    """Deadline of all requests, as a value of `time.monotonic()`."""

    @classmethod
    def opened(cls, server: str | None, token_file: str | None) -> ListClient:
        """Return a reader with the server and the token that commands would use. Raises the errors of `resolve`.

        The user has not confirmed the command line yet. So a token is sent to the address `server` only if the token
        was saved for this address, or if commands without the option `--server` would use this address, too.
        """
        from pathlib import Path

        from marey_client.credentials import resolve, resolve_other

        if server and server.rstrip("/") != _usual_address():
            found = resolve_other(server)
        else:
            found = resolve(server, None if token_file is None else Path(token_file))
        return cls(found, time.monotonic() + PATIENCE_S)

    def ask(self, requests: Sequence[ListRequest]) -> list[list[dict[str, Any]]]:
        """Return the entries of each requested list, in the order of `requests`; a list without an answer is empty."""
        answers: list[list[dict[str, Any]]] = [[] for _ in requests]
        left = iter(list(enumerate(requests)))
        lock = threading.Lock()

        def work() -> None:
            while self._left_s > 0:
                with lock:
                    place, request = next(left, (None, None))
                if place is None or request is None:
                    return
                for page in self._pages(request):
                    answers[place] += page

        threads = [threading.Thread(target=work, daemon=True) for _ in requests[:LISTS_AT_ONCE]]
        for one in threads:
            one.start()
        for one in threads:
            one.join(max(0.0, self._left_s))
        return [list(one) for one in answers]

    def entries(self, *names: str, **query: str | int | None) -> list[dict[str, Any]]:
        """Return the entries of a list, at most `MOST_PAGES` pages; the arguments are those of `ListRequest.of`."""
        return self.ask([replace(ListRequest.of(*names, **query), whole=True)])[0]

    @property
    def _left_s(self) -> float:
        return self.until - time.monotonic()

    def _pages(self, request: ListRequest) -> Iterator[list[dict[str, Any]]]:
        """Yield the entries of each page of a list, page by page; only the first page unless `request.whole`."""
        query = dict(request.query)
        for _ in range(MOST_PAGES if request.whole else 1):
            answer = self._answer(request.path, query)
            yield list(_entries(answer))
            cursor = answer.get("next_cursor") if isinstance(answer, dict) else None
            if not isinstance(cursor, str) or self._left_s <= 0:
                return
            query["cursor"] = cursor

    def _answer(self, path: str, query: Mapping[str, str | int]) -> object:
        """Return the JSON document at a path; None if the server refuses, is too slow, or does not answer with JSON."""
        parts = urlsplit(self.credential.url)
        target = f"{parts.path}{API}{path}?{urlencode(query)}"
        headers = {"Accept": "application/json"}
        if self.credential.token:
            headers["Authorization"] = f"Bearer {self.credential.token}"
        connection = self._connection(parts.scheme, parts.hostname or "", parts.port)
        try:
            connection.request("GET", target, headers=headers)
            answer = connection.getresponse()
            body = answer.read(MOST_ANSWER_BYTES + 1)
            if answer.status != http.HTTPStatus.OK or len(body) > MOST_ANSWER_BYTES:
                return None
            return json.loads(body)
        except (OSError, http.client.HTTPException, ValueError):
            return None
        finally:
            connection.close()

    def _connection(self, scheme: str, host: str, port: int | None) -> http.client.HTTPConnection:
        timeout_s = max(0.01, self._left_s)
        if scheme == "https":
            port = port or http.client.HTTPS_PORT
            return http.client.HTTPSConnection(host, port, timeout=timeout_s, context=self._trusted)
        # Without a port, http.client would take the end of an IPv6 address for one.
        return http.client.HTTPConnection(host, port or http.client.HTTP_PORT, timeout=timeout_s)

    @cached_property
    def _trusted(self) -> ssl.SSLContext:
        from marey_client.credentials import trusted_authorities

        return trusted_authorities()


def _entries(answer: object) -> Iterable[dict[str, Any]]:
    """Yield the objects in an answer: a JSON list, or a page with the member `items`; nothing for any other answer."""
    items = answer.get("items") if isinstance(answer, dict) else answer
    for one in items if isinstance(items, list) else ():
        if isinstance(one, dict):
            yield one


def _usual_address() -> str:
    """Return the address of the server that commands use without the option `--server`."""
    from marey_client.credentials import DEFAULT_URL, logins_path, read_logins

    by_variable = next(filter(None, map(os.environ.get, SERVER_VARIABLES)), None)
    return (by_variable or read_logins(logins_path(os.environ)).default or DEFAULT_URL).rstrip("/")
