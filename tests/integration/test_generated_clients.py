"""Clients that other programs generate from the OpenAPI document, against a real server."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from tests.support.api_document import api_document, document_of
from tests.support.generated_clients import PythonClient, check_typescript_program, generate_python_client
from tests.support.rest_server import Server

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

USED = (
    "get_me_resource", "post_own_tokens", "post_project_imports", "get_items_of_kind", "get_item_resource",
    "get_part_resource", "put_part_resource", "get_export", "post_project_jobs", "get_job_resource", "get_job_log",
    "put_blob", "get_blob", "post_uploads", "patch_upload_resource", "get_upload_resource", "get_events",
)  # fmt: skip
WALK = write_bvh(generate_gait(1.2, 0.0, 1.0))

PROGRAM = Path(__file__).parents[1] / "support" / "api_program.ts"
USED_BY_PROGRAM = (
    "get_items_of_kind", "get_part_resource", "post_project_imports", "get_events", "get_job_log", "post_project_jobs",
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("test_kinds")


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python package, generated for the operations in `USED`."""
    folder = tmp_path_factory.mktemp("generated")
    document = folder / "openapi.json"
    document.write_text(json.dumps(document_of(USED)))
    assert generate_python_client(document, folder / "marey_rest") == []
    return folder / "marey_rest"


@pytest.fixture
def client(package: Path, server: Server) -> PythonClient:
    """A generated client of the owner of the project `lab`."""
    return PythonClient(package, server.address, server.make_project())


def test_a_generated_client_imports_and_reads_a_clip(client: PythonClient) -> None:
    models = client.models
    assert client.call("get_me_resource").user.name == "olga"
    wanted = models.TokenCreate(name="laptop", scopes=["read"])
    assert client.call("post_own_tokens", body=wanted, status=201).secret.startswith("marey_")
    form = models.PostProjectImportsFilesBody(files=[client.file(WALK, "walk.bvh")], collection="raw", tags="a,b")
    (entry,) = client.call("post_project_imports", "lab", body=form).entries
    assert entry.status == "created"
    (clip,) = client.call("get_items_of_kind", "lab", "clips", collection="raw").items
    assert (clip.name, clip.tags) == ("walk", ["a", "b"])

    motion = client.call("get_part_resource", "lab", "clips", clip.id, "motion", frames="0:3")
    assert isinstance(motion, models.MotionDocument)
    packed = client.request("get_part_resource", "lab", "clips", clip.id, "motion", frames="0:3")
    packed["headers"] = {"Accept": "application/msgpack"}
    leaf = msgpack.unpackb(client.connection.get_httpx_client().request(**packed).content)["poses"]
    poses = np.frombuffer(leaf["data"], leaf["dtype"]).reshape(leaf["shape"])
    np.testing.assert_array_equal(poses, np.array(motion.poses.data, motion.poses.dtype))
    exported = client.call("get_export", "lab", "clips", clip.id, format_="npz").payload.read()
    assert np.load(io.BytesIO(exported))["poses"].shape[1] == poses.shape[1]
    assert client.call("get_export", "lab", "clips", clip.id).payload.read() == WALK


def test_a_generated_client_replaces_a_document_and_sends_files_in_pieces(client: PythonClient) -> None:
    models = client.models
    halves = WALK[:1000], WALK[1000:]
    upload = client.call("post_uploads", body=models.UploadCreate(length=len(WALK)), status=201)
    sent = client.call("patch_upload_resource", upload.id, body=client.file(halves[0]), upload_offset=0)
    assert (sent.offset, sent.digest) == (1000, None)
    refused = client.call("patch_upload_resource", upload.id, body=client.file(b"x"), upload_offset=7, status=409)
    assert (refused.code, refused.context.additional_properties["offset"]) == ("wrong-offset", 1000)
    assert client.call("get_upload_resource", upload.id).offset == 1000
    done = client.call("patch_upload_resource", upload.id, body=client.file(halves[1]), upload_offset=1000)
    assert done.digest == f"sha256:{hashlib.sha256(WALK).hexdigest()}"
    assert client.call("get_blob", done.digest).payload.read() == WALK
    assert client.call("put_blob", done.digest, body=client.file(WALK), status=204) is None

    named = models.ImportRequest(files=[models.ImportFile(name="walk.bvh", blob=done.digest)])
    (entry,) = client.call("post_project_imports", "lab", body=named).entries
    clip = client.call("get_item_resource", "lab", "clips", entry.item)
    info = client.call("get_part_resource", "lab", "clips", clip.id, "info")
    assert isinstance(info, models.ClipInfo)
    info.subject = "Nina"
    changed = client.call("put_part_resource", "lab", "clips", clip.id, "info", body=info, if_match="*")
    assert changed.rev > clip.rev
    assert client.call("get_part_resource", "lab", "clips", clip.id, "info").subject == "Nina"
    feed = client.call("get_events", "lab", limit=1)
    assert (len(feed.items), feed.more) == (1, True)
    assert client.call("get_events", "lab", after=feed.items[0].seq).more is False


def test_a_generated_client_submits_a_job_waits_and_reads_its_log(
    client: PythonClient, server: Server, worker: httpx.Client
) -> None:
    models = client.models
    params = models.JobCreateParams.from_dict({"number": 7})
    job = client.call("post_project_jobs", "lab", body=models.JobCreate(kind="errand", params=params), status=202)
    (lease,) = worker.post("/leases", json={"worker": "w", "kinds": ["errand"]}).json()["leases"]
    place = f"/jobs/{job.id}/attempts/{lease['fence']}"
    attempt = server.client(lease["attempt_token"])
    attempt.post(f"{place}/log", content="größer\n".encode(), headers={"Upload-Offset": "0"})
    assert client.call("get_job_resource", job.id).state == "running"
    attempt.post(f"{place}/complete", json={"write_id": "write-one"})
    assert client.call("get_job_resource", job.id, prefer="wait=20").state == "succeeded"
    assert client.call("get_job_log", job.id) == "größer\n"


def typed(document: dict[str, Any], folder: Path) -> str:
    """Return the errors of the TypeScript program with the types of a document."""
    (folder / "openapi.json").write_text(json.dumps(document))
    program = folder / PROGRAM.name
    program.write_text(PROGRAM.read_text())
    return check_typescript_program(folder / "openapi.json", program)


@pytest.mark.node
def test_a_typescript_program_is_checked_with_generated_types(tmp_path: Path) -> None:
    assert typed(document_of(USED_BY_PROGRAM), tmp_path) == ""


@pytest.mark.soak
@pytest.mark.node
def test_the_whole_api_has_typescript_types(tmp_path: Path) -> None:
    assert typed(api_document(), tmp_path) == ""


@pytest.mark.soak
def test_the_whole_api_has_a_python_client(tmp_path: Path) -> None:
    document = tmp_path / "openapi.json"
    document.write_text(json.dumps(api_document()))
    assert generate_python_client(document, tmp_path / "marey_whole") == []
    operations = {
        one["operationId"]
        for entry in api_document()["paths"].values()
        for one in entry.values()
        if isinstance(one, dict)
    }
    client = PythonClient(tmp_path / "marey_whole", "http://localhost", "none")
    assert client.operations == operations
