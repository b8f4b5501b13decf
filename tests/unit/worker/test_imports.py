"""Results of import jobs."""

import hashlib
import json
from math import radians
from pathlib import Path
from typing import Any

from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support.floor_work import floor_work, with_upright_rest
from tests.support.project_in_memory import ProjectInMemory

from marey_motion.clip import Clip
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import ImportParams
from marey_worker.context import FileTooLarge
from marey_worker.kinds import imports

LIMIT_BYTES = 1 << 20


class ProjectWithoutModels(ProjectInMemory):
    """Project in which no model is stored yet."""

    def find_items(self, kind: Kind, name: str, collection: str | None) -> list[Item]:
        return []


class ProjectWithLimit(ProjectInMemory):
    """Project in which a job may read only small files."""

    def blob(self, digest: str) -> bytes:
        if len(data := super().blob(digest)) > LIMIT_BYTES:
            raise FileTooLarge(f"the file has {len(data)} bytes")
        return data


def test_a_file_that_is_too_large_is_refused_and_the_others_are_imported(tmp_path: Path) -> None:
    project = ProjectWithLimit(tmp_path)
    given = {"huge.bvh": bytes(LIMIT_BYTES + 1), "walk.bvh": write_bvh(generate_gait(1.2, 0.0, 0.5))}
    files = []
    for name, data in given.items():
        digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
        project.blobs[digest] = data
        files.append({"name": name, "blob": digest})
    huge, walk = imports.run(project, ImportParams.model_validate({"files": files}))["entries"]
    assert (huge["name"], huge["error"]["code"], walk["status"]) == ("huge.bvh", "file-too-large", "created")


def test_files_with_the_same_skeleton_show_the_axis_of_a_body_on_the_ground(tmp_path: Path) -> None:
    """A crawl alone is refused, because its rest pose has y up on a ground with z up; a later walk shows z."""
    crawl, fall = with_upright_rest(floor_work("crawl")), with_upright_rest(floor_work("fall"))
    walk = with_upright_rest(generate_gait(1.2, 0.2, 2.0, 30.0))

    def entries(given: dict[str, Clip]) -> list[dict[str, Any]]:
        project = ProjectInMemory(tmp_path)
        files = []
        for name, clip in given.items():
            data = write_bvh(clip)
            digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
            project.blobs[digest] = data
            files.append({"name": name, "blob": digest})
        result: list[dict[str, Any]] = imports.run(project, ImportParams.model_validate({"files": files}))["entries"]
        axes = {
            one.item_name: one.parts["info"]["source"]["details"]["up_axis"]
            for one in project.staged
            if one.kind is Kind.CLIP
        }
        return [{**entry, "axis": axes.get(entry["name"].removesuffix(".bvh"))} for entry in result]

    (alone,) = entries({"crawl.bvh": crawl})
    assert (alone["status"], alone["error"]["code"]) == ("failed", "up-axis-ambiguous")
    together = entries({"crawl.bvh": crawl, "fall.bvh": fall, "walk.bvh": walk})
    assert [(one["name"], one["axis"]) for one in together] == [
        ("crawl.bvh", "z"),
        ("fall.bvh", "z"),
        ("walk.bvh", "z"),
    ]


def test_the_result_counts_the_clips_and_frames_that_were_imported(tmp_path: Path) -> None:
    project = ProjectInMemory(tmp_path)
    walk, turn = generate_gait(1.2, 0.0, 0.5), generate_gait(1.2, radians(40), 1.0)
    given = {"walk.bvh": write_bvh(walk), "turn.bvh": write_bvh(turn), "broken.bvh": b"HIERARCHY"}
    files = []
    for name, data in given.items():
        digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
        project.blobs[digest] = data
        files.append({"name": name, "blob": digest})
    result = imports.run(project, ImportParams.model_validate({"files": files}))
    assert [entry["status"] for entry in result["entries"]] == ["created", "created", "failed"]
    assert (result["clips"], result["frames"]) == (2, walk.frame_count + turn.frame_count)
    assert sorted(one.item_name for one in project.staged if one.kind is Kind.CLIP) == ["turn", "walk"]


def test_a_graph_is_imported_after_its_models_whatever_the_order_of_their_names(tmp_path: Path) -> None:
    project = ProjectWithoutModels(tmp_path)
    files = []
    for name, document in (("a.json", old.graph_of_one("stand")), ("stand_mm.json", models.static())):
        data = json.dumps(document).encode()
        digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
        project.blobs[digest] = data
        files.append({"name": name, "blob": digest})
    result = imports.run(project, ImportParams.model_validate({"files": files}))
    assert [(entry["name"], entry["status"]) for entry in result["entries"]] == [
        ("a.json", "created"),
        ("stand_mm.json", "created"),
    ]
