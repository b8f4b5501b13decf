"""Computations in child processes: answers after a child was killed, and the end of work that nobody waits for."""

import http.client
import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from tests.support.api_document import api_document
from tests.support.edited_takes import make_walk
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import Server

from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_schemas.access import ProjectChange, Visibility
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_server.handlers import documentation
from marey_server.handlers.documentation import DESCRIBE_API
from marey_server.motions import previewing
from marey_server.process.children import ChildTask
from marey_server.process.memory import UNKNOWN_CLIENTS

WAITING = "tests.support.child_functions:wait_for"
TRIM = {"commands": [{"command": "trim", "stop": 20}]}


def made(owner: httpx.Client, kind: str, **parts: object) -> str:
    """Create an item and return its id."""
    body = encode_tree({"name": kind, "parts": parts}, MSGPACK)
    headers = {"Content-Type": MSGPACK, "Accept": "application/json"}
    answer = owner.post(f"/projects/lab/{kind}", content=body, headers=headers)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.fixture
def preview(owner: httpx.Client) -> str:
    """The path at which previews of a clip are requested."""
    walk = make_walk(seconds=1.0)
    skeleton = made(owner, "skeletons", hierarchy=skeleton_to_document(walk.skeleton).model_dump(by_alias=True))
    motion = clip_to_document(walk, RevisionRef(item=skeleton, revision=1)).model_dump(by_alias=True)
    return f"/projects/lab/clips/{made(owner, 'clips', motion=motion)}/edit-preview"


@pytest.fixture
def noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file to which a child process that computes a preview writes its process id. The child then waits."""
    monkeypatch.setattr(previewing, "MAKE_PREVIEW", WAITING)
    monkeypatch.setattr(previewing, "preview_order", lambda *_: str(tmp_path / "noted").encode())
    return tmp_path / "noted"


def test_a_request_whose_child_is_killed_is_refused_and_the_next_one_is_answered(
    server: Server, owner: httpx.Client, preview: str, noted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(owner.post, preview, json=TRIM)
        wait_until(noted.exists)
        os.kill(int(noted.read_text()), signal.SIGKILL)
        refused = asked.result()
    assert (refused.status_code, refused.json()["code"]) == (422, "child-died")
    assert "SIGKILL" in refused.json()["detail"]
    assert stopped(server, "died") == 1
    monkeypatch.undo()
    assert owner.post(preview, json=TRIM).json()["frame_count"] == 20


def test_the_child_of_a_client_that_leaves_is_stopped(
    server: Server, owner: httpx.Client, preview: str, noted: Path
) -> None:
    connection = http.client.HTTPConnection(server.address.removeprefix("http://"), timeout=PATIENCE_S)
    headers = {"Authorization": owner.headers["Authorization"], "Content-Type": "application/json"}
    connection.request("POST", f"/api/v1{preview}", json.dumps(TRIM), headers)
    wait_until(noted.exists)
    connection.close()
    wait_until(lambda: not psutil.pid_exists(int(noted.read_text())))
    wait_until(lambda: stopped(server, "client-gone") == 1)
    wait_until(lambda: not server.app.services.in_flight)


def test_all_clients_without_a_user_together_have_the_share_of_one_user(
    server: Server, owner: httpx.Client, preview: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    public = ProjectChange(visibility=Visibility.PUBLIC).model_dump(mode="json", exclude_unset=True)
    assert owner.patch("/projects/lab", json=public, headers={"If-Match": "*"}).status_code == 200
    children = server.app.services.children
    monkeypatch.setattr(children, "limits", replace(children.limits, requests=2))
    with children.request(UNKNOWN_CLIENTS):
        refused = server.client().post(preview, json=TRIM)
        assert (refused.status_code, refused.json()["code"]) == (503, "children-busy")
        assert int(refused.headers["Retry-After"]) > 0
        assert owner.post(preview, json=TRIM).status_code == 200
    assert server.client().post(preview, json=TRIM).status_code == 200


def test_requests_for_the_description_of_the_api_compute_it_once_and_not_in_the_server(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    children = server.app.services.children
    tasks: list[str] = []
    submit = children.submit

    def submit_noted(caller: str, function: str, *rest: Any) -> ChildTask[Any]:
        tasks.append(function)
        return submit(caller, function, *rest)

    monkeypatch.setattr(children, "submit", submit_noted)
    with ThreadPoolExecutor(4) as threads:
        document, page, *again = threads.map(server.client().get, ("/openapi.json", "/docs") * 2)
    assert tasks == [DESCRIBE_API]
    assert document.json()["paths"].keys() == api_document()["paths"].keys()
    assert document.content == again[0].content
    assert page.text.startswith("<!doctype html>")
    assert page.headers["ETag"] == again[1].headers["ETag"]


def test_the_description_of_the_api_is_computed_again_after_its_child_was_killed(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted = tmp_path / "noted"
    monkeypatch.setattr(documentation, "DESCRIBE_API", WAITING)
    monkeypatch.setattr(documentation, "bytes", lambda: str(noted).encode(), raising=False)
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(server.client().get, "/docs")
        wait_until(noted.exists)
        os.kill(int(noted.read_text()), signal.SIGKILL)
        assert (asked.result().status_code, asked.result().json()["code"]) == (422, "child-died")
    monkeypatch.undo()
    assert server.client().get("/docs").status_code == 200


def stopped(server: Server, reason: str) -> float:
    """Return from the metrics how many runs of `wait_for` in child processes were stopped for this reason."""
    lines = dict(line.rsplit(" ", 1) for line in httpx.get(f"{server.address}/metrics").text.splitlines())
    return float(lines.get(f'marey_children_stopped_total{{reason="{reason}",work="wait_for"}}', 0))
