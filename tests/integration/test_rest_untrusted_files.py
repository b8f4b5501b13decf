"""Malicious files that use much memory or time: each is refused, and other requests continue."""

import bz2
import http.client
import io
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import pytest
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import Server, running

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_server.motions import importing
from marey_server.store.database.connections import Database

WAITING = "tests.support.child_functions:wait_in_import"
MEMORY_MB = 96


def bson_bomb(elements: int) -> bytes:
    """Return a compressed document with a list of empty objects; decoded, they take ten times as much memory."""
    members = b"\x03\x00\x05\x00\x00\x00\x00" * elements
    listed = struct.pack("<i", len(members) + 5) + members + b"\x00"
    fields = b"\x04frames\x00" + listed
    return bz2.compress(struct.pack("<i", len(fields) + 5) + fields + b"\x00")


def npz_bomb(megabytes: int) -> bytes:
    """Return an npz archive that is small, but contains `megabytes` MiB of zeros."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as members:
        arrays = {"format": np.array("marey/clip-npz@1"), "poses": np.zeros((megabytes, 1 << 18), np.float32)}
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array)
            members.writestr(f"{name}.npy", content.getvalue())
    return archive.getvalue()


@pytest.fixture
def small(database: Database, tmp_path: Path) -> Iterator[Server]:
    """A server that allows little memory for reading a file: too little to load kernels for the file as well."""
    with running(database, tmp_path, child_memory_mb=MEMORY_MB, warm_up=True) as server:
        yield server


def upload(client: httpx.Client, files: dict[str, bytes]) -> list[dict[str, Any]]:
    """Import files and return the entries of the import, one for each file."""
    answer = client.post("/projects/lab/imports", files=[("files", one) for one in files.items()])
    assert answer.status_code == 200, answer.text
    return answer.json()["entries"]


def test_bombs_are_refused_and_the_files_beside_them_are_imported(small: Server) -> None:
    owner = small.client(small.make_project())
    walk = write_bvh(generate_gait(1.3, 0.0, 1.0))
    files = {
        "a.bvh": walk, "list.bson.bz2": bson_bomb(2_000_000), "zeros.npz": npz_bomb(64), "walk.bvh.gz": b"\x1f\x8b",
        "b.bvh": walk,
    }  # fmt: skip
    entries = upload(owner, files)
    assert [(entry["status"], (entry["error"] or {}).get("code")) for entry in entries] == [
        ("created", None), ("failed", "memory-limit"), ("failed", "memory-limit"), ("failed", "format-archive"),
        ("created", None),
    ]  # fmt: skip
    assert f"{MEMORY_MB} MiB of memory" in entries[1]["error"]["detail"]


def test_a_child_that_dies_costs_one_file(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = server.client(server.make_project())
    monkeypatch.setattr(importing, "READ_FILE", "tests.support.child_functions:crash")
    (entry,) = upload(owner, {"a.bvh": b"HIERARCHY"})
    assert (entry["error"]["code"], "SIGSEGV" in entry["error"]["detail"]) == ("child-died", True)
    monkeypatch.undo()
    assert upload(owner, {"a.bvh": write_bvh(generate_gait(1.3, 0.0, 1.0))})[0]["status"] == "created"


def test_a_second_request_of_a_user_is_refused_while_the_first_uses_the_share(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = server.make_project()
    children = server.app.services.children
    monkeypatch.setattr(children, "limits", replace(children.limits, requests=2))
    monkeypatch.setattr(importing, "READ_FILE", WAITING)
    leaving = begin_import(server, token, tmp_path / "walk")
    refused = server.client(token).post("/projects/lab/imports", files={"files": ("a.bvh", b"HIERARCHY")})
    assert (refused.status_code, refused.json()["code"], "Retry-After" in refused.headers) == (
        503,
        "children-busy",
        True,
    )
    leaving.close()
    wait_until(lambda: not server.app.services.in_flight)


def test_a_client_that_leaves_ends_the_work_for_it(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = server.make_project()
    monkeypatch.setattr(importing, "READ_FILE", WAITING)
    leaving = begin_import(server, token, tmp_path / "walk")
    process = int((tmp_path / "walk").read_text())
    assert psutil.pid_exists(process)
    leaving.close()
    wait_until(lambda: not psutil.pid_exists(process))
    wait_until(lambda: not server.app.services.in_flight)


def begin_import(server: Server, token: str, noted: Path) -> http.client.HTTPConnection:
    """Import a file that makes a child process wait; return the connection as soon as the child waits."""
    connection = http.client.HTTPConnection(server.address.removeprefix("http://"), timeout=PATIENCE_S)
    body = f'--b\r\nContent-Disposition: form-data; name="files"; filename="a.bvh"\r\n\r\n{noted}\r\n--b--\r\n'
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "multipart/form-data; boundary=b"}
    connection.request("POST", "/api/v1/projects/lab/imports", body, headers)
    wait_until(noted.exists)
    return connection
