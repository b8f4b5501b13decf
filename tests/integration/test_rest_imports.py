"""Import and export of motion files over HTTP."""

import hashlib
import io
import json
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support.floor_work import floor_work, with_upright_rest
from tests.support.folded_rig import folded
from tests.support.motion_files import AMC, ASF
from tests.support.rest_server import Server, running

from marey_motion.formats import read_motion, write_bvh, write_predecessor, write_predecessor_skeleton
from marey_motion.gait import generate_gait
from marey_motion.kinematics import forward_kinematics
from marey_server.store.database.connections import Database

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 9 -8 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -42 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT LeftFoot
      {
        OFFSET 0 -43 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET 0 -6 14
        }
      }
    }
  }
  JOINT RightUpLeg
  {
    OFFSET -9 -8 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT RightLeg
    {
      OFFSET 0 -42 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT RightFoot
      {
        OFFSET 0 -43 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET 0 -6 14
        }
      }
    }
  }
  JOINT Spine
  {
    OFFSET 0 20 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Head
    {
      OFFSET 0 40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 20 0
      }
    }
  }
}
MOTION
Frames: 12
Frame Time: 0.033333
"""


def bvh(seed: int = 0) -> bytes:
    """Return a BVH file of a small body that moves a little."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(scale=5, size=(12, 3 + 3 * 9))
    rows[:, 1] += 99
    return (BVH + "\n".join(" ".join(f"{value:.4f}" for value in row) for row in rows) + "\n").encode()


def send(client: httpx.Client, files: dict[str, bytes], **fields: str) -> httpx.Response:
    parts = [("files", (name, data)) for name, data in files.items()]
    return client.post("/projects/lab/imports", files=parts, data=fields)


def statuses(answer: httpx.Response) -> dict[str, str]:
    assert answer.status_code == 200, answer.text
    return {entry["name"]: entry["status"] for entry in answer.json()["entries"]}


def test_good_files_go_in_and_each_bad_one_is_refused_with_its_place(owner: httpx.Client) -> None:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as packed:
        packed.writestr("walk.bvh", bvh())
    lines = bvh(1).splitlines()
    lines[-3] = lines[-3].replace(b" ", b" oops ", 1)
    files = {
        "take/walk.bvh": bvh(),
        "take/broken.bvh": b"\n".join(lines),
        "take/all.zip": archive.getvalue(),
        "empty.bvh": b"",
        "lonely.amc": b":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n",
    }
    answer = send(owner, files, collection="raw", tags="a,b", subject="S1")
    assert statuses(answer) == {name: "created" if name == "take/walk.bvh" else "failed" for name in files}
    entries = {entry["name"]: entry for entry in answer.json()["entries"]}
    assert entries["take/broken.bvh"]["error"]["line"] == len(lines) - 2
    assert "unpack" in entries["take/all.zip"]["error"]["detail"]
    assert entries["lonely.amc"]["error"]["code"] == "asf-missing"
    made = owner.get(f"/projects/lab/clips/{entries['take/walk.bvh']['item']}").json()
    assert (made["name"], made["collection"], made["tags"]) == ("walk", "raw/take", ["a", "b"])
    assert made["summary"]["frames"] == entries["take/walk.bvh"]["frames"] == 12
    info = owner.get(f"/projects/lab/clips/{made['id']}/parts/info").json()
    assert info["subject"] == "S1"
    assert info["source"]["file_name"] == "walk.bvh"


def test_files_of_one_request_with_the_same_skeleton_show_the_axis(owner: httpx.Client) -> None:
    crawl = ("files", ("crawl.bvh", write_bvh(with_upright_rest(floor_work("crawl")))))
    walk = ("files", ("walk.bvh", write_bvh(with_upright_rest(generate_gait(1.2, 0.2, 2.0, 30.0)))))
    (alone,) = owner.post("/projects/lab/imports", files=[crawl]).raise_for_status().json()["entries"]
    assert alone["error"]["code"] == "up-axis-ambiguous"
    both = owner.post("/projects/lab/imports", files=[crawl, walk]).raise_for_status().json()["entries"]
    assert [(entry["name"], entry["status"]) for entry in both] == [("crawl.bvh", "created"), ("walk.bvh", "created")]
    axes = {
        owner.get(f"/projects/lab/clips/{entry['item']}/parts/info").json()["source"]["details"]["up_axis"]
        for entry in both
    }
    assert axes == {"z"}


def test_a_file_that_is_sent_without_a_form_is_refused_with_the_type_of_forms(owner: httpx.Client) -> None:
    headers = {"Content-Type": "application/x-www-form-urlencoded"}
    refused = owner.post("/projects/lab/imports", content=bvh(), headers=headers)
    assert refused.status_code == 415
    assert "accepts only: multipart/form-data, application/json" in refused.json()["detail"]


def test_file_names_with_control_characters_are_refused_and_harm_no_other(owner: httpx.Client) -> None:
    def part(file_name: str) -> bytes:
        head = f'--B\r\nContent-Disposition: form-data; name="files"; filename="{file_name}"\r\n\r\n'
        return head.encode() + bvh() + b"\r\n"

    names = [name.format(sign) for name in ("a{}b.bvh", "dir{}/a.bvh") for sign in ("%0D%0A", "\x07", "\x7f", "\0")]
    answer = owner.post(
        "/projects/lab/imports",
        content=b"".join(map(part, [*names, "walk.bvh"])) + b"--B--\r\n",
        headers={"Content-Type": "multipart/form-data; boundary=B"},
    )
    *refused, taken = answer.json()["entries"]
    assert [entry["error"]["code"] for entry in refused] == ["name-invalid"] * len(names)
    assert (taken["name"], taken["status"]) == ("walk.bvh", "created")


def test_the_same_file_again_changes_nothing_and_a_new_take_makes_a_revision(owner: httpx.Client) -> None:
    first = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]
    again = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]
    assert (again["status"], again["item"], again["revision"]) == ("unchanged", first["item"], 1)
    other = send(owner, {"walk.bvh": bvh(1)}).json()["entries"][0]
    assert (other["item"], other["revision"]) == (first["item"], 2)
    assert other["skeleton"] == first["skeleton"]
    assert len(owner.get("/projects/lab/skeletons").json()["items"]) == 1


def test_an_import_keeps_the_take_record_of_the_clip(owner: httpx.Client) -> None:
    first = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]
    info_url = f"/projects/lab/clips/{first['item']}/parts/info"
    stored = owner.get(info_url)
    record = {"action": "walk", "consent_until": "2020-01-31", "consent_for": ["games"], "comment": "limps"}
    put = owner.put(info_url, json={**stored.json(), **record}, headers={"If-Match": stored.headers["ETag"]})
    assert put.is_success, put.text
    again = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]
    assert (again["status"], again["revision"]) == ("unchanged", 2)
    other = send(owner, {"walk.bvh": bvh(1)}, licence="CC0-1.0").json()["entries"][0]
    assert (other["item"], other["revision"]) == (first["item"], 3)
    info = owner.get(info_url).json()
    assert {name: info[name] for name in record} == record
    assert info["licence"] == "CC0-1.0"
    refused = owner.get(f"/projects/lab/clips/{first['item']}/export")
    assert (refused.status_code, refused.json()["code"]) == (409, "consent-expired")


def test_files_can_be_named_by_digest(owner: httpx.Client, server: Server) -> None:
    data = bvh()
    digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
    request = {"files": [{"name": "walk.bvh", "blob": digest}], "collection": "raw"}
    assert owner.post("/projects/lab/imports", json=request).status_code == 404
    assert owner.put(f"/blobs/{digest}", content=data).status_code == 204
    assert statuses(owner.post("/projects/lab/imports", json=request)) == {"walk.bvh": "created"}
    stranger = server.client(server.make_user("stranger"))
    assert stranger.get(f"/blobs/{digest}").status_code == 404


def test_the_original_comes_back_byte_for_byte_under_its_name(owner: httpx.Client) -> None:
    item = send(owner, {"take/Gang é.bvh": bvh()}).json()["entries"][0]["item"]
    original = owner.get(f"/projects/lab/clips/{item}/export")
    assert original.content == bvh()
    assert "filename*=UTF-8''Gang%20%C3%A9.bvh" in original.headers["Content-Disposition"]


def test_an_exported_bvh_moves_as_the_imported_one(owner: httpx.Client) -> None:
    item = send(owner, {"walk.bvh": bvh()}, unit="cm").json()["entries"][0]["item"]
    exported = owner.get(f"/projects/lab/clips/{item}/export", params={"format": "bvh", "unit": "m"})
    folded = owner.get(f"/projects/lab/clips/{item}/export", params={"format": "bvh", "fold_positions": "true"})
    assert folded.content.count(b"position") == 3
    refused = owner.get(f"/projects/lab/clips/{item}/export", params={"format": "npz", "fold_positions": "true"})
    assert (refused.status_code, "use bvh" in refused.text) == (400, True)
    assert exported.headers["Content-Disposition"].startswith('attachment; filename="walk.bvh"')
    ours = read_motion(exported.content, "walk.bvh").clip
    theirs = read_motion(bvh(), "walk.bvh").clip
    assert ours is not None
    assert theirs is not None
    there, here = (forward_kinematics(clip.skeleton, clip.poses)[0] for clip in (theirs, ours))
    np.testing.assert_allclose(here, there, atol=1e-4)


@pytest.mark.parametrize("file_format", ["npz", "predecessor", "json"])
def test_clips_leave_in_other_formats(owner: httpx.Client, file_format: str) -> None:
    item = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]["item"]
    exported = owner.get(f"/projects/lab/clips/{item}/export", params={"format": file_format})
    assert exported.status_code == 200, exported.text
    assert len(exported.content) > 1000


def test_the_same_files_by_another_way_to_the_same_folder_change_nothing(owner: httpx.Client) -> None:
    files = {"walk.bvh": bvh(), "arm.asf": ASF.encode(), "arm_01.amc": AMC.encode()}
    first = send(owner, {f"cmu/{name}": data for name, data in files.items()}, collection="raw")
    assert statuses(first) == {"cmu/walk.bvh": "created", "cmu/arm.asf": "companion", "cmu/arm_01.amc": "created"}
    again = send(owner, files, collection="raw/cmu")
    assert statuses(again) == {"walk.bvh": "unchanged", "arm.asf": "companion", "arm_01.amc": "unchanged"}
    items = [[entry["item"] for entry in answer.json()["entries"]] for answer in (first, again)]
    assert items[0] == items[1]


def test_a_clip_of_the_predecessor_is_imported_with_the_skeleton_beside_it(owner: httpx.Client) -> None:
    walk = generate_gait(1.2, 0.0, 1.0, 30.0)
    files = {
        "old/skeleton.json": write_predecessor_skeleton(walk.skeleton),
        "old/walk.bson.bz2": write_predecessor(walk),
    }
    answer = send(owner, files)
    assert statuses(answer) == {"old/skeleton.json": "created", "old/walk.bson.bz2": "created"}
    skeleton, clip = answer.json()["entries"]
    assert clip["skeleton"] == skeleton["item"]
    assert clip["frames"] == 30
    item = owner.get(f"/projects/lab/clips/{clip['item']}").json()
    assert (item["collection"], item["name"]) == ("old", "walk")


def test_a_graph_is_imported_after_its_models_whatever_the_order_of_their_names(owner: httpx.Client) -> None:
    documents = {"a.json": old.graph_of_one("stand"), "stand_mm.json": models.static()}
    files = [("files", (name, json.dumps(document).encode())) for name, document in documents.items()]
    entries = owner.post("/projects/lab/imports", files=files).json()["entries"]
    assert [entry["name"] for entry in entries] == ["a.json", "stand_mm.json"]
    assert [entry["status"] for entry in entries] == ["created", "created"]


def test_clips_can_be_made_to_use_a_given_skeleton(owner: httpx.Client) -> None:
    skeleton = send(owner, {"walk.bvh": bvh()}).json()["entries"][0]["skeleton"]
    other_body = bvh(1).replace(b"OFFSET 0 -42 0", b"OFFSET 0 -45 0")
    answer = send(owner, {"run.bvh": bvh(1), "tall.bvh": other_body}, skeleton=skeleton)
    assert statuses(answer) == {"run.bvh": "created", "tall.bvh": "failed"}
    entries = answer.json()["entries"]
    assert entries[1]["error"]["code"] == "skeleton-mismatch"
    motion = owner.get(f"/projects/lab/clips/{entries[0]['item']}/parts/motion").json()
    assert motion["skeleton"] == {"item": skeleton, "revision": 1}


def test_unknown_options_and_empty_requests_are_refused(owner: httpx.Client) -> None:
    assert send(owner, {"walk.bvh": bvh()}, colour="red").json()["errors"][0]["pointer"] == "/colour"
    assert send(owner, {"walk.bvh": bvh()}, unit="mile").status_code == 422
    multipart = {"Content-Type": "multipart/form-data; boundary=b"}
    empty = owner.post("/projects/lab/imports", content=b"--b--\r\n", headers=multipart)
    assert (empty.status_code, empty.json()["code"]) == (400, "no-files")
    cut = owner.post("/projects/lab/imports", content=b"--b\r\n", headers=multipart)
    assert (cut.status_code, cut.json()["code"]) == (400, "bad-multipart")


def test_large_imports_become_a_job(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, import_files_now=2) as server:
        owner = server.client(server.make_project())
        files = {f"walk{number}.bvh": bvh(number) for number in range(3)}
        answer = send(owner, files, collection="raw")
        assert answer.status_code == 202
        job = answer.json()
        assert answer.headers["Location"] == f"/api/v1/jobs/{job['id']}"
        assert job["kind"] == "import"
        digests = [f"sha256:{hashlib.sha256(data).hexdigest()}" for data in files.values()]
        assert [file["blob"] for file in job["params"]["files"]] == digests
        assert owner.post("/blobs/missing", json={"digests": digests}).json()["missing"] == []


def test_every_bvh_of_real_capture_comes_back_byte_for_byte(owner: httpx.Client, mocap: Path) -> None:
    files = sorted(mocap.glob("*/*.bvh"))[:40]
    assert files
    answer = send(owner, {str(path.relative_to(mocap)): path.read_bytes() for path in files})
    for path, entry in zip(files, answer.json()["entries"], strict=True):
        if entry["status"] == "failed":
            assert entry["error"]["code"] in ("units-ambiguous", "up-axis-ambiguous"), entry
            continue
        assert entry["status"] == "created", entry
        assert owner.get(f"/projects/lab/clips/{entry['item']}/export").content == path.read_bytes()


def test_events_tell_what_happened_and_can_be_followed(owner: httpx.Client) -> None:
    send(owner, {"walk.bvh": bvh()})
    told = owner.get("/projects/lab/events").json()["items"]
    assert [event["kind"] for event in told if event["kind"].startswith("item.")] == ["item.created"] * 2
    headers = {"Accept": "text/event-stream", "Last-Event-ID": str(told[-2]["seq"])}
    with owner.stream("GET", "/projects/lab/events", headers=headers) as stream:
        assert stream.headers["Content-Type"] == "text/event-stream"
        lines = (line for line in stream.iter_lines() if line.startswith("id: "))
        assert next(lines) == f"id: {told[-1]['seq']}"
        owner.post("/projects/lab/collections", json={"path": "later"})
        assert int(next(lines).removeprefix("id: ")) > told[-1]["seq"]


def test_the_order_of_takes_does_not_change_the_joint_map_of_their_skeleton(owner: httpx.Client) -> None:
    """The rest pose of this rig shows no axes, and each of the takes would show others."""
    takes = [write_bvh(folded(generate_gait(1.4, 0.0, 2.0, 30.0), twisted)) for twisted in (0.0, 0.9)]
    mappings = []
    for project, order in (("first", takes), ("second", takes[::-1])):
        owner.post("/projects", json={"name": project}).raise_for_status()
        for number, take in enumerate(order):
            sent = owner.post(f"/projects/{project}/imports", files=[("files", (f"take{number}.bvh", take))])
            assert statuses(sent) == {f"take{number}.bvh": "created"}
        (skeleton,) = owner.get(f"/projects/{project}/skeletons").raise_for_status().json()["items"]
        part = owner.get(f"/projects/{project}/skeletons/{skeleton['id']}/parts/mapping")
        mappings.append(part.raise_for_status().json())

    assert mappings[0] == mappings[1]
    assert "LeftForeArm" not in mappings[0]["axes"]
