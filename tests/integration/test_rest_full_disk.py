"""A server whose disk is full: it still reads and deletes, stores nothing, and reports the full disk."""

from __future__ import annotations

from types import SimpleNamespace

import httpx
import pytest
from tests.support.rest_server import ALL_SCOPES, Server

STUDY = {"name": "s", "parts": {"character": {"schema": "marey/document@1", "answer": 42}}}


def test_a_full_server_reads_and_deletes_and_stores_nothing(
    server: Server, owner: httpx.Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    item = f"/projects/lab/characters/{owner.post('/projects/lab/characters', json=STUDY).json()['id']}"
    administrator = server.client(server.make_user("ada", administrator=True, scopes=ALL_SCOPES))
    monkeypatch.setattr("shutil.disk_usage", lambda _folder: SimpleNamespace(free=1000))
    monkeypatch.setattr("marey_server.process.disk_space.LOOK_AGAIN_S", 0)
    refused = [
        owner.post("/projects/lab/characters", json=STUDY),
        owner.put(f"/blobs/sha256:{'0' * 64}", content=b"x"),
        owner.post("/projects/lab/imports", files={"files": ("a.bvh", b"x")}),
    ]
    assert [(answer.status_code, answer.json()["code"]) for answer in refused] == [(507, "storage-full")] * 3
    assert (
        server.client("marey_aaaaaaaaaaaa_" + "b" * 64).post("/projects/lab/characters", json=STUDY).status_code == 401
    )
    ready = f"{server.address}/readyz"
    token = administrator.headers["Authorization"]
    strangers, operators = httpx.get(ready), httpx.get(ready, headers={"Authorization": token})
    assert (strangers.status_code, strangers.json()["code"]) == (503, "not-ready")
    assert "MiB" not in strangers.text
    assert "MiB free" in operators.json()["detail"]
    assert any("MiB free" in record.getMessage() for record in caplog.records)
    assert owner.get(item).status_code == 200
    assert owner.delete(item, headers={"If-Match": "*"}).status_code == 204
    monkeypatch.undo()
    monkeypatch.setattr("marey_server.process.disk_space.LOOK_AGAIN_S", 0)
    assert owner.post("/projects/lab/characters", json=STUDY).status_code == 201
    assert httpx.get(ready).status_code == 200
