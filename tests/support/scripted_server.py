"""Simulated server in the process of a test of the client: it sends prepared answers and records every request."""

import json
from collections.abc import Callable
from typing import Any

import httpx

from marey_client.marey import Marey
from marey_client.retries import Retries

Answer = httpx.Response | Exception | Callable[[httpx.Request], Any]
"""A response, an error to raise, or a function that answers the request."""


def problem(
    status: int, code: str, *, retry_after: int | None = None, detail: str = "the reason", **members: Any
) -> httpx.Response:
    """Return an error response with a problem document, as the server sends it; `members` are further members."""
    document = {
        "type": "about:blank", "title": "t", "status": status, "detail": detail, "instance": "req-1", "code": code,
    }  # fmt: skip
    headers = {"Content-Type": "application/problem+json"}
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return httpx.Response(status, content=json.dumps({**document, **members}), headers=headers)


def folder(path: str) -> httpx.Response:
    """Return the answer to the client's lookup of a folder: the list of folders of a project with the folder `path`."""
    now = "2026-01-01T00:00:00Z"
    return httpx.Response(
        200, json={"items": [{"id": "collection_1", "path": path, "created_at": now, "updated_at": now, "rev": 1}]}
    )


class ScriptedServer:
    """Answers that are sent one after another, the received requests, and the seconds that a real client would wait."""

    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.requests: list[httpx.Request] = []
        self.waited: list[float] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        """Record the request, and return the next prepared answer, or raise it if it is an error."""
        request.read()
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer if isinstance(answer, httpx.Response) else answer(request)

    def transport(self) -> httpx.MockTransport:
        """Return the connection of a client to this server."""
        return httpx.MockTransport(self)

    def marey(self, **options: Any) -> Marey:
        """Return a client of this server whose waits take no time."""
        retries = Retries(sleep=self.waited.append, random_unit=lambda: 0.0)
        return Marey(
            "http://server.test/",
            "marey_secret",
            http=self.transport(),
            **dict[str, Any](retries=retries) | options,
        )
