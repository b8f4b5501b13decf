"""Questions to the server for shell completion: with the saved token, few at a time, and for less than a second.

Uses `http.client` instead of the SDK, because loading the SDK takes longer than all questions together.
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
"""Time in seconds for all answers to one press of the Tab key, without the start of the program (about 0.4 s)."""
QUESTIONS_AT_ONCE = 4
MOST_ENTRIES = 200
"""Greatest number of entries of one page."""
MOST_PAGES = 50
MOST_ANSWER_BYTES = 1 << 22


@dataclass(frozen=True)
class Question:
    """Path of a list below the address of the API, and its query parameters."""

    path: str
    query: Mapping[str, str | int] = field(default_factory=dict)
    whole: bool = False
    """Whether further pages are asked for while time is left."""

    @classmethod
    def of(cls, *names: str, **query: str | int | None) -> Question:
        """Return the question for a path whose names are quoted here; parameters that are None are left out."""
        path = "/".join(quote(name, safe="") for name in names)
        asked = {"limit": MOST_ENTRIES, **query}
        return cls(f"/{path}", {key: value for key, value in asked.items() if value is not None})


@dataclass(frozen=True)
class Desk:
    """Answers questions about what the token may read."""

    credential: Credential
    until: float
    """Time of `time.monotonic()` after which nothing is waited for."""

    @classmethod
    def opened(cls, server: str | None, token_file: str | None) -> Desk:
        """Return the desk of the server and the token that commands would use. Raises errors of credentials.

        Nobody has confirmed the line yet, so an address on it gets a token only if the token was saved for it, or if
        commands without this address would use the same one.
        """
        from pathlib import Path

        from marey_client.credentials import resolve, resolve_other

        if server and server.rstrip("/") != _usual_address():
            found = resolve_other(server)
        else:
            found = resolve(server, None if token_file is None else Path(token_file))
        return cls(found, time.monotonic() + PATIENCE_S)

    def ask(self, questions: Sequence[Question]) -> list[list[dict[str, Any]]]:
        """Return the entries of the answers, in the order of the questions; none for a question without an answer."""
        answers: list[list[dict[str, Any]]] = [[] for _ in questions]
        left = iter(list(enumerate(questions)))
        lock = threading.Lock()

        def work() -> None:
            while self._left_s > 0:
                with lock:
                    place, question = next(left, (None, None))
                if place is None or question is None:
                    return
                for page in self._pages(question):
                    answers[place] += page

        threads = [threading.Thread(target=work, daemon=True) for _ in questions[:QUESTIONS_AT_ONCE]]
        for one in threads:
            one.start()
        for one in threads:
            one.join(max(0.0, self._left_s))
        return [list(one) for one in answers]

    def entries(self, *names: str, **query: str | int | None) -> list[dict[str, Any]]:
        """Return the entries of one list with all pages for which there is time, as for `Question.of`."""
        return self.ask([replace(Question.of(*names, **query), whole=True)])[0]

    @property
    def _left_s(self) -> float:
        return self.until - time.monotonic()

    def _pages(self, question: Question) -> Iterator[list[dict[str, Any]]]:
        """Yield the entries of the pages of a list."""
        query = dict(question.query)
        for _ in range(MOST_PAGES if question.whole else 1):
            answer = self._answer(question.path, query)
            yield list(_entries(answer))
            cursor = answer.get("next_cursor") if isinstance(answer, dict) else None
            if not isinstance(cursor, str) or self._left_s <= 0:
                return
            query["cursor"] = cursor

    def _answer(self, path: str, query: Mapping[str, str | int]) -> object:
        """Return an answer; None if the server refuses the question, is too slow, or is none of ours."""
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
    """Yield the objects of a list, whether it has pages or not."""
    items = answer.get("items") if isinstance(answer, dict) else answer
    for one in items if isinstance(items, list) else ():
        if isinstance(one, dict):
            yield one


def _usual_address() -> str:
    """Return the address that commands use if there is none on the line."""
    from marey_client.credentials import DEFAULT_URL, logins_path, read_logins

    by_variable = next(filter(None, map(os.environ.get, SERVER_VARIABLES)), None)
    return (by_variable or read_logins(logins_path(os.environ)).default or DEFAULT_URL).rstrip("/")
