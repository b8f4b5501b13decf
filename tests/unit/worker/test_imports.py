"""Results of import jobs."""

import hashlib
from math import radians
from pathlib import Path

from tests.support.project_in_memory import ProjectInMemory

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import ImportParams
from marey_worker.context import FileTooLarge
from marey_worker.kinds import imports

LIMIT_BYTES = 1 << 20


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
