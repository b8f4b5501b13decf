"""In-process server: a function from request to response."""

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from marey_client.marey import Marey
from marey_client.retries import Retries


def problem(
    status: int, code: str, *, retry_after: int | None = None, detail: str = "the reason", **members: Any
) -> httpx.Response:
    told = {"type": "about:blank", "title": "t", "status": status, "detail": detail, "instance": "req-1", "code": code}
    headers = {"Content-Type": "application/problem+json"}
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return httpx.Response(status, content=json.dumps({**told, **members}), headers=headers)


class Scripted:
    """Answers one after another; an exception is raised instead of answered. Remembers every request."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.requests: list[httpx.Request] = []
        self.waited: list[float] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer(request) if callable(answer) else answer

    def marey(self, **options: Any) -> Marey:
        retries = Retries(sleep=self.waited.append, random_unit=lambda: 0.0)
        return Marey(
            "http://server.test/", "marey_secret", http=httpx.MockTransport(self), **{"retries": retries, **options}
        )


@pytest.fixture
def script() -> Scripted:
    return Scripted()


@pytest.fixture
def make_problem() -> Callable[..., httpx.Response]:
    return problem
