"""A server behind nginx, with the example in `deploy/proxies`: uploads, events and ranges pass through the proxy.

TLS is removed from the example, because it needs a certificate.
"""

import hashlib
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from docs.generate import ROOT
from tests.support.patience import PATIENCE_S
from tests.support.server_process import ServerProcess, reserved_port

NGINX = shutil.which("nginx", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
UPLOAD_BYTES = 32 * 2**20
UPLOAD_PAUSE_S = 20.0

pytestmark = pytest.mark.skipif(NGINX is None, reason="nginx is not installed; the example of nginx was not run")


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Client of a server behind nginx."""
    folder = tmp_path_factory.mktemp("nginx")
    server = ServerProcess(folder, MAREY_TRUST_PROXY="true").start()
    port = reserved_port()
    proxy = subprocess.Popen([str(NGINX), "-c", str(_write_configuration(folder, port, server.port))])
    try:
        address = f"http://127.0.0.1:{port}"
        _wait_for(address)
        with httpx.Client(base_url=address, timeout=PATIENCE_S) as client:
            client.headers = {"Authorization": f"Bearer {server.token}"}
            yield client
    finally:
        proxy.terminate()
        proxy.wait(PATIENCE_S)
        server.stop()


def _write_configuration(folder: Path, port: int, server_port: int) -> Path:
    text = (ROOT / "deploy" / "proxies" / "nginx.conf").read_text(encoding="utf-8")
    text = re.sub(r"^server \{\n    listen 80;.*?^\}\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^ *(ssl_\w+|listen \[::\]).*\n", "", text, flags=re.MULTILINE)
    text = text.replace("listen 443 ssl http2;", f"listen 127.0.0.1:{port};")
    text = text.replace("127.0.0.1:8460", f"127.0.0.1:{server_port}")
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    folders = " ".join(f"{kind}_temp_path {folder}/bodies/{kind};" for kind in kinds)
    (folder / "bodies").mkdir()
    file = folder / "nginx.conf"
    file.write_text(
        f"daemon off; master_process off; pid {folder}/nginx.pid; error_log {folder}/error.log;\nevents {{}}\n"
        f"http {{ access_log off; {folders}\n{text} }}\n"
    )
    return file


def _wait_for(address: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            if httpx.get(f"{address}/readyz", timeout=5).status_code == 200:
                return
        except httpx.TransportError:
            time.sleep(0.05)
    raise AssertionError("nginx does not answer")


def _wait_for_bytes(client: httpx.Client, upload: str) -> int:
    """Return how many bytes of the upload the server has, as soon as it has some, or 0 after some seconds."""
    deadline = time.monotonic() + UPLOAD_PAUSE_S
    while time.monotonic() < deadline:
        if offset := int(client.get(f"/api/v1/uploads/{upload}").json()["offset"]):
            return offset
        time.sleep(0.05)
    return 0


def test_an_upload_and_a_range_pass_through(client: httpx.Client) -> None:
    data = os.urandom(UPLOAD_BYTES)
    upload = client.post("/api/v1/uploads", json={"length": len(data)}).json()["id"]
    arrived: list[int] = []

    def pieces() -> Iterator[bytes]:
        yield data[: UPLOAD_BYTES // 2]
        arrived.append(_wait_for_bytes(client, upload))
        yield data[UPLOAD_BYTES // 2 :]

    headers = {"Upload-Offset": "0", "Content-Type": "application/octet-stream", "Content-Length": str(len(data))}
    done = client.patch(f"/api/v1/uploads/{upload}", content=pieces(), headers=headers)
    digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
    assert (done.status_code, done.json()["digest"]) == (200, digest)
    assert arrived[0] > 0, "nginx stored the upload before it passed it on"
    part = client.get(f"/api/v1/blobs/{digest}", headers={"Range": "bytes=1048576-1048585"})
    assert (part.status_code, part.content) == (206, data[2**20 : 2**20 + 10])


def test_events_arrive_while_the_stream_is_open(client: httpx.Client) -> None:
    project = client.post("/api/v1/projects", json={"name": "lab"})
    events = "/api/v1/projects/lab/events"
    with client.stream("GET", events, headers={"Accept": "text/event-stream"}) as stream:
        lines = stream.iter_lines()
        with closing(stream):
            assert "event: project.created" in (next(lines) for _ in range(5))
            changed = client.patch(
                "/api/v1/projects/lab", json={"description": "new"}, headers={"If-Match": project.headers["ETag"]}
            )
            assert changed.status_code == 200
            assert "event: project.changed" in (next(lines) for _ in range(10))
