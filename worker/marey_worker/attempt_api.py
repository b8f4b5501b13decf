"""Requests of a worker to the server about its jobs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import msgpack

from marey_client.blobs import Blobs
from marey_client.errors import Conflict, LeaseLost, Unauthenticated
from marey_client.paging import pages
from marey_client.retries import Retries
from marey_client.transport import BLOCKS, Transport, as_json, read_model
from marey_schemas.items import Item, PartPlace, PartsRequest
from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import Progress, TaskResult
from marey_schemas.queue.worker_protocol import (
    ClaimRequest,
    CompleteRequest,
    FailRequest,
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    LeaseList,
    LogAnswer,
)
from marey_schemas.studies.conducting import JudgingParticipant

PATIENT = Retries(tries=100, longest_s=10.0, total_s=600.0)
"""Retries, for up to 10 minutes, of requests without which computed results would be lost."""

PLAIN_TEXT = "text/plain; charset=utf-8"

_NONE: bytes = msgpack.packb(None)


def claim_from(transport: Transport, request: ClaimRequest) -> LeaseList:
    """Claim jobs. If the answer is lost, the request is repeated and gets the same leases."""
    response = transport.send(
        "POST", "/leases", content=as_json(request), repeatable=True, timeout_s=request.wait_s + 30.0
    )
    return read_model(LeaseList, response)


class AttemptApi:
    """Client for the requests of one attempt of a job, with the attempt's token.

    Every method may raise `LeaseLost`.
    """

    def __init__(self, transport: Transport, lease: Lease) -> None:
        self._transport = transport.with_token(lease.attempt_token)
        self._patient = transport.with_token(lease.attempt_token, retries=PATIENT)
        self._project = lease.project
        self._job = lease.job
        self._url = f"/jobs/{lease.job}/attempts/{lease.fence}"

    def heartbeat(self, progress: Progress | None, *, patiently: bool = False) -> HeartbeatAnswer:
        """Renew the lease, and report the progress; return the answer of the server."""
        sender = self._patient if patiently else self._transport
        return read_model(HeartbeatAnswer, self._post("heartbeat", as_json(Heartbeat(progress=progress)), sender))

    def append_log(self, offset: int, piece: bytes) -> LogAnswer:
        """Append `piece` to the attempt's log, and return the length of the log, as the server knows it.

        `offset` is the length of the log before. If it is wrong, nothing is appended.
        """
        headers = {"Upload-Offset": str(offset)}
        try:
            return read_model(LogAnswer, self._post("log", piece, media_type=PLAIN_TEXT, headers=headers))
        except LeaseLost:
            raise
        except Conflict as error:
            return LogAnswer(offset=error.context["offset"])

    def stage(self, body: bytes) -> None:
        """Send outputs, given as an encoded `StageRequest`; they are published if the attempt completes."""
        self._post("outputs", body, self._patient, media_type=BLOCKS)

    def complete(self, request: CompleteRequest) -> None:
        """Publish the staged outputs and end the job; a repeated request gets the same answer."""
        self._post("complete", as_json(request), self._patient)

    def fail(self, request: FailRequest) -> None:
        """End the attempt without success; a repeated request gets the same answer."""
        self._post("fail", as_json(request))

    def read_parts(self, places: Sequence[PartPlace]) -> list[bytes | None]:
        """Return documents as undecoded MessagePack with block-encoded arrays, and None for each missing document.

        The result is in the order of `places`. Documents at the end of a long list may be omitted, but not the first
        one.
        """
        path = f"/projects/{self._project}/parts"
        body = as_json(PartsRequest(parts=tuple(places)))
        with _dead_token_is_lost_lease():
            answer = self._transport.send("POST", path, content=body, repeatable=True, headers={"Accept": BLOCKS})
        return _split_documents(answer.content)

    def read_item(self, kind: Kind, item: str) -> Item:
        """Return an item at its newest revision."""
        with _dead_token_is_lost_lease():
            return self._transport.get(Item, f"/projects/{self._project}/{kind.plural}/{item}")

    def find_items(self, kind: Kind, name: str, collection: str | None) -> list[Item]:
        """Return the items with this name in one folder, or in the whole project if `collection` is None."""
        asked = f"{name}*" if name.endswith("*") else name  # a final asterisk asks for names that begin so
        query = {"name": asked, "directly_in": collection}
        with _dead_token_is_lost_lease():
            found = pages(self._transport, Item, f"/projects/{self._project}/{kind.plural}", query)
            return [item for item in found if item.name == name]

    def read_results(self) -> list[dict[str, Any]]:
        """Return the results of the job's tasks, in order."""
        with _dead_token_is_lost_lease():
            return [one.result or {} for one in pages(self._transport, TaskResult, f"/jobs/{self._job}/results")]

    def read_judgements(self, study: str, revision: int) -> list[dict[str, Any]]:
        """Return the answers of participants who saw a revision of a study, one document for each participant."""
        with _dead_token_is_lost_lease():
            path = f"{self._url}/judgements/{study}"
            people = pages(self._transport, JudgingParticipant, path, {"revision": revision})
            return [one.model_dump(mode="json") for one in people]

    def read_blob(self, digest: str, most_bytes: int) -> bytes:
        """Return a blob's bytes by its digest. Raises `BlobTooLarge` before the download of more than `most_bytes`."""
        with _dead_token_is_lost_lease():
            return Blobs(self._transport).fetch(digest, most_bytes=most_bytes)

    def put_file(self, path: Path) -> str:
        """Send a file to the server, which stores it as a blob, and return its digest."""
        with _dead_token_is_lost_lease():
            return Blobs(self._patient).put_file(path)

    def _post(
        self, name: str, content: bytes | None, transport: Transport | None = None, **options: Any
    ) -> httpx.Response:
        with _dead_token_is_lost_lease():
            sender = transport or self._transport
            return sender.send("POST", f"{self._url}/{name}", content=content, repeatable=True, **options)


@contextmanager
def _dead_token_is_lost_lease() -> Iterator[None]:
    """Convert a refusal of the token to `LeaseLost`, because an attempt's token becomes invalid with its lease."""
    try:
        yield
    except Unauthenticated as error:
        raise LeaseLost(error.problem) from error


def _split_documents(data: bytes) -> list[bytes | None]:
    """Return the bytes of each document in the MessagePack of `{"documents": [...]}`."""
    unpacker = msgpack.Unpacker(max_buffer_size=len(data))
    unpacker.feed(data)
    if unpacker.read_map_header() != 1 or unpacker.unpack() != "documents":
        raise ValueError(
            "the server's answer to a request for several documents must be an object with the single key `documents`"
        )
    documents: list[bytes | None] = []
    for _ in range(unpacker.read_array_header()):
        start = unpacker.tell()
        unpacker.skip()
        document = data[start : unpacker.tell()]
        documents.append(None if document == _NONE else document)
    return documents
