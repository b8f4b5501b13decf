"""Searches by example in indexes that somebody has written by hand, with arbitrary files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.rest_server import stored_file
from tests.support.studying import make_study

from marey_motion.arrays import Ints
from marey_motion.documents import clip_to_tree, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_motion.similarity.features import clip_features
from marey_motion.similarity.shards import Runs, Shard, write_shard
from marey_schemas.documents.metrics import built_in_metric
from marey_schemas.documents.motion_indexes import IndexShard, ShardClips
from marey_schemas.search import SimilarRequest
from marey_schemas.sizes import MIB
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import pack_tree
from marey_server.motions.index_shards import ShardFiles
from marey_server.motions.similar import FoundWindows, SimilarOrder, search_index

ONE = {"items": ["clip_a"], "revisions": [1], "rows": [60], "joints": [1], "frames": [60], "rates_hz": [30.0]}


def searched(owner: httpx.Client, clip: str, **shard: Any) -> tuple[int, str]:
    """Store an index of one shard without the fields that may be absent, and search it."""
    index = {"schema": "marey/motion-index@1", "clips": 1, "rows": 60, "shards": [{"rows": 60, **shard}]}
    made = owner.post("/projects/lab/indexes", json={"name": "index", "parts": {"index": index}})
    assert made.status_code == 201, made.text
    assert made.json()["summary"]["left_out"] == 0
    item = made.json()["id"]
    answer = owner.post("/projects/lab/similar", json={"clip": clip, "frames": [0, 1], "index": item})
    assert owner.delete(f"/projects/lab/indexes/{item}", headers={"If-Match": "*"}).is_success
    return answer.status_code, answer.json()["code"]


def test_a_search_refuses_an_index_whose_files_have_other_sizes(owner: httpx.Client) -> None:
    make_study(owner, 4)
    listed = owner.get("/projects/lab/clips")
    assert listed.headers["Cache-Control"] == "private, no-cache", "no cache may keep what a cookie has shown"
    clip = listed.json()["items"][0]["id"]
    poses, clips = stored_file(owner, b"no poses"), stored_file(owner, json.dumps(ONE).encode())
    wrong = {**poses, "size_bytes": 0}
    assert searched(owner, clip, clips=clips, poses=wrong) == (404, "no-index"), "a stated size is no promise"


@pytest.mark.parametrize(
    ("content", "dropped"),
    [
        (b"{", ()),
        (b"\xff\xfe", ()),
        (json.dumps({**ONE, "rows": [-60]}).encode(), ()),
        (json.dumps(ONE).encode(), (1,)),
    ],
)
def test_a_search_refuses_damaged_lists_of_clips(tmp_path: Path, content: bytes, dropped: tuple[int, ...]) -> None:
    (tmp_path / "clips").write_bytes(content)
    shard = ShardFiles(clips=str(tmp_path / "clips"), poses=str(tmp_path / "poses"), dropped=dropped)
    request = SimilarRequest(clip="clip_a", frames=(0, 1))
    order = SimilarOrder(
        request=request, metric=built_in_metric(request.metric), revision=1, motion=b"", first=0, hierarchy=b"",
        mapping=None, shards=(shard,), heads={},
    )  # fmt: skip
    with pytest.raises(NotFoundProblem, match="damaged"):
        search_index(order.pack())


@pytest.mark.parametrize(
    ("name", "value"),
    [("rows", -1), ("rows", 2**63), ("joints", -1), ("revisions", 2**70), ("frames", -1), ("rates_hz", 0.0)],
)
def test_lists_of_clips_contain_only_possible_numbers(name: str, value: float) -> None:
    assert ShardClips.model_validate(ONE).rows == (60,)
    with pytest.raises(ValueError, match=name):
        ShardClips.model_validate({**ONE, name: [value]})
    file = {"blob": f"sha256:{'0' * 64}", "size_bytes": 1}
    with pytest.raises(ValueError, match="dropped"):
        IndexShard.model_validate({"clips": file, "poses": file, "rows": 1, "dropped": [-1]})


def test_changed_dropped_and_left_out_clips_are_not_searched_and_unknown_ones_are_counted(tmp_path: Path) -> None:
    clip = generate_gait(1.3, 0.2, 3.0, 30.0)
    rows = clip_features(
        Motion.of(clip), MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton)), 30.0
    ).rows
    shards = []
    for number, ids in enumerate((("clip_a", "clip_b", "clip_c"), ("clip_d", "clip_e"))):
        count = len(ids)
        lists = {"items": ids, "revisions": [2] * count, "rows": [len(rows)] * count, "joints": [2**15 - 1] * count}
        lists |= {"frames": [len(rows)] * count, "rates_hz": [30.0] * count}
        clips, poses = tmp_path / f"clips{number}", tmp_path / f"poses{number}"
        clips.write_text(json.dumps(lists))
        write_shard(poses, [rows] * count)
        shards.append(ShardFiles(clips=str(clips), poses=str(poses), dropped=(1,) if number == 0 else ()))
    # clip_c was deleted, clip_d changed, clip_e was restored, and clip_f is new.
    heads = {"clip_c": 0, "clip_d": 3, "clip_e": 2, "clip_f": 1}
    for leave_out, expected in (("nothing", {"clip_a", "clip_e"}), ("clip", {"clip_e"})):
        order = SimilarOrder(
            request=SimilarRequest(clip="clip_a", frames=(30, 45), leave_out=leave_out, results=50),
            metric=built_in_metric("published/positions-sigmoid"), revision=2,
            motion=pack_tree(clip_to_tree(clip, {"item": "skeleton_a", "revision": 1})), first=30,
            hierarchy=pack_tree(skeleton_to_document(clip.skeleton).model_dump(by_alias=True)), mapping=None,
            shards=tuple(shards), heads=heads,
        )  # fmt: skip
        for _ in range(2):  # the second search uses what the first has kept
            found = FoundWindows.unpack(search_index(order.pack()))
            assert {one.clip for one in found.windows} == expected
            assert (found.searched_clips, found.behind) == (len(expected), 2)
            assert found.windows[0].distance == pytest.approx(0.0, abs=1e-3)


def test_a_second_search_uses_the_mapped_shards_until_their_files_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = generate_gait(1.3, 0.2, 3.0, 30.0)
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    rows = clip_features(Motion.of(clip), body, 30.0).rows
    write_shard(tmp_path / "poses", [rows, rows])
    for name, lengths in (("clips", [len(rows)] * 2), ("other", [2 * len(rows)]), ("wrong", [len(rows)])):
        (tmp_path / name).write_text(json.dumps({
            "items": [f"clip_{number}" for number in range(len(lengths))], "revisions": [1] * len(lengths),
            "rows": lengths, "frames": lengths, "joints": [2**15 - 1] * len(lengths), "rates_hz": [30.0] * len(lengths),
        }), encoding="utf-8")  # fmt: skip
    opened: list[Path] = []
    plain_open = Shard.open

    def counted_open(path: Path, runs: Runs, joints: Ints) -> Shard:
        opened.append(path)
        return plain_open(path, runs, joints)

    monkeypatch.setattr(Shard, "open", counted_open)

    def found(listed: str) -> FoundWindows:
        shard = ShardFiles(clips=str(tmp_path / listed), poses=str(tmp_path / "poses"), dropped=())
        order = SimilarOrder(
            request=SimilarRequest(clip="clip_x", frames=(30, 45)), metric=built_in_metric("published/sigmoid"),
            revision=1, motion=pack_tree(clip_to_tree(clip, {"item": "skeleton_a", "revision": 1})), first=30,
            hierarchy=pack_tree(skeleton_to_document(clip.skeleton).model_dump(by_alias=True)), mapping=None,
            shards=(shard,), heads={},
        )  # fmt: skip
        return FoundWindows.unpack(search_index(order.pack()))

    assert {one.clip for one in found("clips").windows} == {"clip_0", "clip_1"}
    assert found("clips") == found("clips")
    assert len(opened) == 1
    assert {one.clip for one in found("other").windows} == {"clip_0"}, "the same poses beside another list of clips"
    with pytest.raises(InvalidProblem, match="no shard of a motion index"):
        found("wrong")
    (tmp_path / "poses").unlink()
    with pytest.raises(NotFoundProblem, match="removed"):
        found("clips")


def test_mapped_files_do_not_count_as_memory_of_a_child(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(200 * MIB)
    program = f"""
import mmap
from marey_schemas.processes.limits import allow_mapped_files, allow_memory
def is_refused(make):
    try:
        make()
    except (OSError, MemoryError):
        return True
    return False
file = open({str(tmp_path / "large")!r}, "rb")
kept = []
allow_memory(100 * 2**20)
assert is_refused(lambda: mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)), "the limit holds"
allow_mapped_files(200 * 2**20)
assert not is_refused(lambda: kept.append(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))
assert is_refused(lambda: bytearray(120 * 2**20)), "the mapped file gives no other memory"
assert not is_refused(lambda: bytearray(50 * 2**20))
kept.clear()
allow_mapped_files(-200 * 2**20)
assert is_refused(lambda: bytearray(120 * 2**20))
"""
    subprocess.run([sys.executable, "-c", program], check=True)
