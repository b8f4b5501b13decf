"""Compressed bodies and answers of the requests that copy versions."""

from __future__ import annotations

import httpx
import pytest
import zstandard
from tests.support.rest_server import noted_memory

from marey_schemas.encoding.compression import compress

CONTENTS = "/projects/lab/contents"
ABSENT = b"sha256:" + b"2" * 64
BODY = b'{"revisions": [' + b", ".join([b'"' + ABSENT + b'"'] * 30) + b"]}"
JSON = {"Content-Type": "application/json"}
COMPRESSED = JSON | {"Content-Encoding": "zstd"}


def test_a_compressed_body_has_the_same_answer(owner: httpx.Client) -> None:
    plain = owner.post(CONTENTS, content=BODY, headers=JSON)
    assert plain.status_code == 200
    found = owner.post(CONTENTS, content=compress(BODY), headers=COMPRESSED)
    assert (found.status_code, found.json()) == (200, plain.json())


def test_long_answers_are_compressed_for_callers_who_accept_it(owner: httpx.Client) -> None:
    asked = {"json": {"revisions": [ABSENT.decode()] * 256}}
    plain = owner.post(CONTENTS, headers={"Accept-Encoding": "gzip"}, **asked)
    packed = owner.post(CONTENTS, headers={"Accept-Encoding": "zstd"}, **asked)
    assert (plain.status_code, "Content-Encoding" in plain.headers) == (200, False)
    assert packed.headers["Content-Encoding"] == "zstd"
    assert int(packed.headers["Content-Length"]) < len(plain.content) / 10
    assert packed.json() == plain.json()
    short = owner.post(CONTENTS, headers={"Accept-Encoding": "zstd"}, json={"revisions": [ABSENT.decode()]})
    assert "Content-Encoding" not in short.headers


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        (BODY, 400, "bad-compression"),
        (compress(BODY)[:-3], 400, "bad-compression"),
        (compress(BODY) + b"more", 400, "bad-compression"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(BODY), 400, "bad-compression"),
        (compress(b"x"), 400, "bad-syntax"),
        (compress(b" " * (1 << 30)), 413, "too-large"),
    ],
    ids=["plain", "cut", "longer", "without-size", "no-json", "bomb"],
)
def test_a_body_that_is_not_one_zstd_frame_is_refused(owner: httpx.Client, body: bytes, status: int, code: str) -> None:
    answer = owner.post(CONTENTS, content=body, headers=COMPRESSED)
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text


def test_the_content_of_a_compressed_body_counts_as_memory(
    owner: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = noted_memory(monkeypatch)
    assert owner.post(CONTENTS, content=compress(BODY), headers=COMPRESSED).status_code == 200
    assert {len(BODY), len(compress(BODY))} <= set(taken)


def test_other_requests_refuse_compressed_bodies(owner: httpx.Client) -> None:
    body = compress(b'{"name": "gaits"}')
    assert owner.post("/projects/lab/datasets", content=body, headers=COMPRESSED).status_code == 415
