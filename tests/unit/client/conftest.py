"""In-process server: a function from request to response."""

import json

import httpx
import pytest

from marey_client.marey import Marey
from marey_client.retries import Retries


def problem(status, code, *, retry_after=None, detail="the reason", **members):
    told = {"type": "about:blank", "title": "t", "status": status, "detail": detail, "instance": "req-1", "code": code}
    headers = {"Content-Type": "application/problem+json"}
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return httpx.Response(status, content=json.dumps({**told, **members}), headers=headers)


class Scripted:
    """Answers one after another; an exception is raised instead of answered. Remembers every request."""

    def __init__(self):
        self.answers = []
        self.requests = []
        self.waited = []

    def __call__(self, request):
        request.read()
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer(request) if callable(answer) else answer

    def marey(self, **options):
        retries = Retries(sleep=self.waited.append, random_unit=lambda: 0.0)
        return Marey(
            "http://server.test/", "marey_secret", http=httpx.MockTransport(self), **{"retries": retries, **options}
        )


@pytest.fixture
def script():
    return Scripted()


@pytest.fixture
def make_problem():
    return problem
