"""Resumable uploads of large files."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.present import present
from tests.support.scripted_server import ScriptedServer, problem

from marey_client import blobs, errors

DATA = bytes(range(251)) * 100


class UploadServer:
    """Simulated server that stores the bytes of one upload.

    Each number n in `faults` breaks the connection of one request, after the server has stored n bytes of the piece.
    """

    def __init__(self) -> None:
        self.kept = bytearray()
        self.faults: list[int] = []
        self.sent = 0
        self.announced: dict[str, Any] | None = None
        self.finished = False

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        if request.method == "POST":
            self.announced = json.loads(request.content)
        if request.method == "PATCH":
            if int(request.headers["Upload-Offset"]) != len(self.kept):
                return problem(409, "wrong-offset", context={"offset": len(self.kept)})
            self.sent += len(request.content)
            keep = self.faults.pop(0) if self.faults else None
            self.kept += request.content[:keep]
            if keep is not None:
                raise httpx.ReadError("connection reset")
            self.finished = len(self.kept) == len(DATA)
        digest = f"sha256:{hashlib.sha256(self.kept).hexdigest()}" if self.finished else None
        shown = {"id": "up1", "length": len(DATA), "offset": len(self.kept), "digest": digest}
        return httpx.Response(200, json=shown)


@pytest.fixture
def upload_server(monkeypatch: pytest.MonkeyPatch) -> UploadServer:
    monkeypatch.setattr(blobs, "PIECE_BYTES", 4096)
    monkeypatch.setattr(blobs, "RESUMABLE_FROM_BYTES", 1000)
    return UploadServer()


@pytest.fixture
def send(script: ScriptedServer, upload_server: UploadServer, tmp_path: Path) -> Callable[[], str]:
    path = tmp_path / "large.bvh"
    path.write_bytes(DATA)
    script.answers = [upload_server] * 100
    return lambda: script.marey().blobs.put_file(path)


def test_a_large_file_goes_in_pieces_under_its_digest(send: Callable[[], str], upload_server: UploadServer) -> None:
    assert send() == f"sha256:{hashlib.sha256(DATA).hexdigest()}"
    assert bytes(upload_server.kept) == DATA
    assert present(upload_server.announced)["length"] == len(DATA)


@pytest.mark.parametrize("kept", [0, 1000, 4096])
def test_after_a_lost_connection_it_goes_on_where_the_server_is(
    send: Callable[[], str], upload_server: UploadServer, kept: int
) -> None:
    upload_server.faults = [4096, kept]
    send()
    assert bytes(upload_server.kept) == DATA
    assert upload_server.sent <= len(DATA) + 4096


def test_a_last_piece_whose_answer_was_lost_still_becomes_a_blob(
    send: Callable[[], str], upload_server: UploadServer
) -> None:
    upload_server.faults = [4096] * 6 + [len(DATA)]
    assert send().startswith("sha256:")
    assert upload_server.finished


def test_a_connection_that_never_lets_a_piece_through_is_given_up(
    send: Callable[[], str], upload_server: UploadServer
) -> None:
    upload_server.faults = [0] * 100
    with pytest.raises(errors.Unreachable):
        send()
    assert upload_server.sent == blobs.TRIES_PER_PIECE * 4096


def test_a_file_that_shrinks_is_noticed(script: ScriptedServer, upload_server: UploadServer, tmp_path: Path) -> None:
    path = tmp_path / "large.bvh"
    path.write_bytes(DATA)

    def shrink(request: httpx.Request) -> httpx.Response:
        path.write_bytes(b"")
        return upload_server(request)

    script.answers = [upload_server, shrink, upload_server]
    with pytest.raises(errors.FileChanged, match="was shortened"):
        script.marey().blobs.put_file(path)
