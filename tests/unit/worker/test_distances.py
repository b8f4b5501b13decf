"""Jobs of the kind `distances`: the same result for any division into tasks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, cast

import pytest

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_tree, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_schemas.encoding.codecs import JSON, decode_tree
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue import job_params
from marey_schemas.queue.job_params import DistancesParams, count_distance_tasks
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused, Task
from marey_worker.kinds.distances import gather, run

LOOPLESS = "standing"


@cache
def walks() -> dict[str, Clip]:
    walks = {f"walk {speed}": generate_gait(speed, 0.0, 3.0, 30.0) for speed in (0.9, 1.1, 1.3, 1.5, 1.7)}
    still = walks["walk 0.9"].sliced(0, 4)
    return {**dict(list(walks.items())[:3]), LOOPLESS: still, **dict(list(walks.items())[3:])}


class StoredClips:
    """Context of a task of a job that compares `walks`; tasks share their files."""

    def __init__(self, scratch: Path, files: dict[str, bytes], task: Task) -> None:
        self.scratch, self.task, self.threads = scratch, task, 1
        self.inputs = {"clips": tuple(
            PinnedInput(item=f"clip_{number}", revision=1, kind=Kind.CLIP, name=name, collection="")
            for number, name in enumerate(walks())
        )}  # fmt: skip
        self.files = files
        self.notes: list[str] = []
        self.motions_read = 0

    def documents(
        self, pins: Sequence[PinnedInput], part: str, *, required: bool = True
    ) -> Iterator[tuple[PinnedInput, Any]]:
        for pin in pins:
            self.motions_read += part == "motion"
            skeleton = {"item": "skeleton_x", "revision": 1}
            yield pin, clip_to_tree(walks()[pin.name], skeleton) if part == "motion" else None

    def document(self, _kind: Kind, _item: str, _revision: int, part: str, *, required: bool = True) -> Any:
        skeleton = walks()[LOOPLESS].skeleton
        return skeleton_to_document(skeleton).model_dump(by_alias=True) if part == "hierarchy" else None

    def progress(self, _done: float, _total: float | None, note: str) -> None:
        self.notes.append(note)

    def log(self, text: str) -> None:
        self.notes.append(text)

    def put_file(self, file: Path) -> str:
        content = file.read_bytes()
        self.files[digest_of(content)] = content
        return digest_of(content)

    def blob(self, digest: str) -> bytes:
        return self.files[digest]


def compared(folder: Path, tasks: int) -> tuple[dict[str, Any], dict[str, bytes], list[StoredClips]]:
    """Run all tasks of a job, the last first, and combine their results."""
    params, files = DistancesParams(report=False), dict[str, bytes]()
    contexts = [StoredClips(folder, files, Task(position, tasks)) for position in range(tasks)]
    results = [run(cast(Context, context), params) for context in reversed(contexts)][::-1]
    whole = StoredClips(folder, files, Task(0, 1))
    return gather(cast(Context, whole), params, results), files, contexts


def test_the_number_of_tasks_changes_nothing_in_the_result(tmp_path: Path) -> None:
    whole, files, _ = compared(tmp_path, 1)
    assert (whole["clips"], whole["pairs"]) == (5, 10)
    assert [one["name"] for one in whole["refused"]] == [LOOPLESS]
    table = decode_tree(files[whole["document"]["blob"]], JSON)["distances"]
    assert sum(float(one) == 0.0 for row in table for one in row) == 5, "every pair was compared"
    assert min(float(one) for row in table for one in row if float(one) > 0) == whole["nearest"]["distance"]
    split, _, contexts = compared(tmp_path, 6)  # three blocks of two clips
    assert split == whole, "documents and maps have the same digests"
    for context in contexts:
        measured = {note for note in context.notes if note.startswith("measuring")}
        assert len(measured) <= 4, "a task measures the clips of two blocks"


def test_only_the_first_task_in_a_process_reads_all_clips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marey_worker.kinds.distances._RIGS", LruCache(max_entries=1))
    result, _, contexts = compared(tmp_path, 6)  # three blocks of two clips; the last task runs first
    assert [context.motions_read for context in reversed(contexts)] == [6, 4, 2, 4, 4, 2]
    assert compared(tmp_path, 6)[0] == result, "a task that reads its own clips alone gives the same bytes"


def test_the_number_of_tasks_depends_on_that_of_the_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    params = DistancesParams()
    assert [count_distance_tasks(params, clips) for clips in (0, 2, 50, 51, 400, 500)] == [1, 1, 1, 3, 36, 55]
    assert count_distance_tasks(params, 501) == 1, "its only task refuses the job"
    monkeypatch.setattr("marey_worker.kinds.distances.MOST_COMPARED_CLIPS", 5)
    with pytest.raises(JobRefused, match="6 clips are given, and at most 5"):
        compared(Path("unused"), 1)
    assert job_params.MOST_COMPARED_CLIPS == 500
