"""Blobs: upload and download by digest."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client import errors
from marey_client.blobs import Blobs
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import BlobsQuery

DATA = bytes(range(256)) * 4096


class Torn(httpx.SyncByteStream):
    """An answer whose connection breaks after some bytes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __iter__(self) -> Iterator[bytes]:
        yield self.data
        raise httpx.ReadError("connection reset")


def test_a_file_is_streamed_with_its_length(script: ScriptedServer, tmp_path: Path) -> None:
    path = tmp_path / "walk.bvh"
    path.write_bytes(DATA)
    script.answers = [httpx.ReadError("lost"), httpx.Response(204)]
    digest = script.marey().blobs.put_file(path)
    assert digest == digest_of(DATA) == f"sha256:{hashlib.sha256(DATA).hexdigest()}"
    assert [request.content for request in script.requests] == [DATA, DATA]
    assert script.requests[0].headers["Content-Length"] == str(len(DATA))
    assert script.requests[0].url.path.endswith(digest)


@pytest.mark.parametrize(("became", "told"), [(DATA[:1000], "was shortened"), (DATA * 3, "grew")])
def test_a_file_whose_length_changes_while_it_is_sent_is_told(
    script: ScriptedServer, tmp_path: Path, became: bytes, told: str
) -> None:
    path = tmp_path / "walk.bvh"
    path.write_bytes(DATA)

    def change_and_lose(_request: httpx.Request) -> None:
        path.write_bytes(became)
        raise httpx.ReadError("lost")

    script.answers = [change_and_lose]
    with pytest.raises(errors.FileChanged, match=rf"walk\.bvh {told}"):
        script.marey().blobs.put_file(path)


def test_a_download_goes_on_where_the_connection_broke(script: ScriptedServer, tmp_path: Path) -> None:
    def rest(request: httpx.Request) -> httpx.Response:
        start = int(request.headers["Range"].removeprefix("bytes=").rstrip("-"))
        return httpx.Response(206, content=DATA[start:])

    script.answers = [httpx.Response(200, stream=Torn(DATA[:1000])), rest]
    target = script.marey().blobs.fetch_to(digest_of(DATA), tmp_path / "out" / "walk.bvh")
    assert target.read_bytes() == DATA
    assert script.requests[1].headers["Range"] == "bytes=1000-"


def test_a_download_starts_again_where_ranges_are_not_known(script: ScriptedServer, tmp_path: Path) -> None:
    script.answers = [httpx.Response(200, stream=Torn(DATA[:1000])), httpx.Response(200, content=DATA)]
    assert script.marey().blobs.fetch_to(digest_of(DATA), tmp_path / "walk").read_bytes() == DATA


def test_other_bytes_than_those_asked_for_are_never_kept(script: ScriptedServer, tmp_path: Path) -> None:
    script.answers = [httpx.Response(200, content=b"other"), httpx.Response(200, content=b"other")]
    blobs = script.marey().blobs
    with pytest.raises(errors.DigestMismatch):
        blobs.fetch(digest_of(DATA))
    with pytest.raises(errors.DigestMismatch):
        blobs.fetch_to(digest_of(DATA), tmp_path / "walk")
    assert list(tmp_path.iterdir()) == []


def test_a_blob_is_not_downloaded_if_it_is_larger_than_allowed(script: ScriptedServer) -> None:
    endless = httpx.Response(200, headers={"Content-Length": str(1 << 40)}, stream=Torn(b""))
    script.answers = [endless, httpx.Response(200, content=DATA)]
    with pytest.raises(errors.BlobTooLarge, match=f"has {1 << 40} bytes"):
        script.marey().blobs.fetch(digest_of(DATA), most_bytes=len(DATA))
    assert script.marey().blobs.fetch(digest_of(DATA), most_bytes=len(DATA)) == DATA


def test_thousands_of_digests_are_asked_for_in_few_questions(script: ScriptedServer) -> None:
    digests = [f"sha256:{number:064x}" for number in range(12_000)]

    def answer(request: httpx.Request) -> httpx.Response:
        asked = BlobsQuery.model_validate_json(request.content).digests
        return httpx.Response(200, json={"missing": asked[:1]})

    script.answers = [answer, answer]
    assert Blobs(script.marey().transport).missing(digests * 2) == {digests[0], digests[10_000]}
