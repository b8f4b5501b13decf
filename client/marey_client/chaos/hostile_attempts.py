"""Attempts that violate the protocol of workers: lost answers, repetitions, stale fences and wrong clocks."""

from __future__ import annotations

import random
import secrets
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from typing import Any

from marey_client.errors import MareyError
from marey_client.load.calling import LoadAnswer, LoadConnection, connection
from marey_client.load.scratch import KIND, Scratch

RESULT = "result"
SKEW_S = 3600
OVER = frozenset({401, 404, 409})
"""HTTP statuses with which the server may refuse a request of an attempt whose lease or job has ended."""


class HostileAttempt:
    """Attempt to run one job of the test, which also sends faulty requests.

    `claim`, `stage`, `complete` and `refused` raise `MareyError` if the server answers wrongly.
    """

    def __init__(self, scratch: Scratch, caller: LoadConnection, job: str, draw: random.Random) -> None:
        self._scratch, self._caller, self._job, self._draw = scratch, caller, job, draw

    def claim(self, claim_id: str | None = None) -> dict[str, Any]:
        """Claim the job and return its lease as a dict; a repeated `claim_id` must return the same lease."""
        wanted = {
            "worker": "chaos", "kinds": [KIND], "labels": self._scratch.labels, "job": self._job,
            "claim_id": claim_id or secrets.token_hex(16),
        }  # fmt: skip
        leases = self._require(self._caller.post("/leases", wanted, headers=self._skewed())).document["leases"]
        if len(leases) != 1:
            raise MareyError(f"a claim of the queued job {self._job} got {len(leases)} leases instead of one")
        return dict(leases[0])

    def post(self, lease: dict[str, Any], what: str, document: dict[str, Any]) -> LoadAnswer:
        """Send the request `what`, such as "complete", of the attempt, with a wrong time in the header `Date`."""
        path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/{what}"
        return self._caller.post(path, document, token=lease["attempt_token"], headers=self._skewed())

    def lose_answer(self, lease: dict[str, Any], what: str, document: dict[str, Any]) -> None:
        """Send the request `what` of the attempt over a new connection, and close it without reading the answer."""
        with connection(self._scratch.url, lease["attempt_token"]) as other:
            other.send_only(f"/jobs/{lease['job']}/attempts/{lease['fence']}/{what}", document)

    def stage(self, lease: dict[str, Any]) -> None:
        """Stage a skeleton with a random joint offset, so that each attempt has a different result."""
        offset = [round(self._draw.random(), 6), 0.0, 0.0]
        hierarchy = {"schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": offset}]}
        output = {"name": RESULT, "kind": "skeleton", "item_name": RESULT, "parts": {"hierarchy": hierarchy}}
        self._require(self.post(lease, "outputs", {"outputs": [output]}))

    def complete(self, lease: dict[str, Any], write_id: str) -> LoadAnswer:
        """Complete the attempt, and return the answer."""
        return self._require(self.post(lease, "complete", {"write_id": write_id}))

    def refused(self, answer: LoadAnswer, what: str) -> None:
        """Raise `MareyError` unless `answer` refuses the request that `what` describes."""
        if answer.status not in OVER:
            raise MareyError(f"the server must refuse {what} of the job {self._job}, but answered {answer.status}")

    def _require(self, answer: LoadAnswer) -> LoadAnswer:
        if answer.code:
            detail = answer.document.get("detail", answer.code)
            raise MareyError(f"the server refused a request for the job {self._job}: {detail}")
        return answer

    def _skewed(self) -> dict[str, str]:
        skew = timedelta(seconds=self._draw.uniform(-SKEW_S, SKEW_S))
        return {"Date": format_datetime(datetime.now(UTC) + skew, usegmt=True)}


def lost_answers(attempt: HostileAttempt) -> None:
    """Repeat a claim and a completion whose answers are lost; each repetition must get the answer that was lost."""
    claim_id = secrets.token_hex(16)
    first = attempt.claim(claim_id)
    lease = attempt.claim(claim_id)
    if (first["fence"], first["attempt_token"]) != (lease["fence"], lease["attempt_token"]):
        raise MareyError(f"a repeated claim of the job {lease['job']} got another attempt")
    attempt.stage(lease)
    write_id = secrets.token_hex(16)
    attempt.lose_answer(lease, "complete", {"write_id": write_id})
    answers = [attempt.complete(lease, write_id).document for _ in range(2)]
    if answers[0] != answers[1]:
        raise MareyError(f"repeated completions of the job {lease['job']} got different answers")


def double_completion(attempt: HostileAttempt) -> None:
    """Complete a job, then complete it again with another `write_id`, which the server must refuse."""
    lease = attempt.claim()
    attempt.stage(lease)
    attempt.complete(lease, secrets.token_hex(16))
    attempt.refused(attempt.post(lease, "complete", {"write_id": secrets.token_hex(16)}), "a second completion")
    attempt.refused(attempt.post(lease, "heartbeat", {}), "a heartbeat after the end")


def stale_fence(attempt: HostileAttempt) -> None:
    """Release a job, claim it again, and write as the first attempt; the server must refuse these writes."""
    stale = attempt.claim()
    attempt.stage(stale)
    gone = {"write_id": secrets.token_hex(16), "code": "interrupted", "interrupted": True}
    if (answer := attempt.post(stale, "fail", gone)).code:
        raise MareyError(f"the server refused to take back the job {stale['job']}: {answer.code}")
    lease = attempt.claim()
    for what, document in (("heartbeat", {}), ("complete", {"write_id": secrets.token_hex(16)})):
        attempt.refused(attempt.post(stale, what, document), f"a {what} of a stale attempt")
        newest = {**stale, "fence": lease["fence"]}
        attempt.refused(attempt.post(newest, what, document), f"a {what} with the token of a stale attempt")
    attempt.stage(lease)
    attempt.complete(lease, secrets.token_hex(16))
    attempt.refused(attempt.post(stale, "complete", {"write_id": secrets.token_hex(16)}), "a late completion")


HOSTILE_CASES: dict[str, Callable[[HostileAttempt], None]] = {
    "lost answers to claim and completion": lost_answers,
    "double completion": double_completion,
    "completion with a stale fence": stale_fence,
}
"""Functions that run one attempt with faults, by the name of the fault."""
