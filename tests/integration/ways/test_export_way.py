"""Workflow of a dataset that other programs use: exported in all layouts, and uploaded again, as the page shows."""

from __future__ import annotations

import csv
import json
import re
import shlex
import signal
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import pytest
from tests.support.command_line import CommandLine

from marey_client.blobs import digest_of_file
from marey_client.bridges import files as exporting
from marey_client.errors import CannotExport, Conflict, FolderNotEmpty
from marey_client.handles.clips import ClipHandle
from marey_client.handles.datasets import DatasetHandle
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.datasets.exports import ExportedFolder
from marey_schemas.kinds import Kind
from marey_versions.records import revision_content

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "use-a-dataset-elsewhere.md"


@pytest.fixture
def project(lab_of: Callable[..., ProjectHandle], run: CommandLine, tmp_path: Path) -> ProjectHandle:
    """A project with the dataset `gaits`: walks with take records, one of them the result of a job."""
    for name, step in (("walk", 0.5), ("turn", 0.6)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    made = lab_of(tmp_path / "walk.bvh", tmp_path / "turn.bvh", collection="gaits/raw")
    record = {"subject": "02", "action": "walk, slowly", "licence": "CC BY 4.0", "consent_for": ("research",)}
    clip(made, "walk").put_info(clip(made, "walk").info().model_copy(update={**record, "comment": 'a "comment"\n2'}))
    run("tag", "lab/gaits/raw/turn", "--add", "fast")
    made.datasets.create("gaits", collection="gaits")
    gaits = gaits_of(made)
    gaits.commit("Takes")
    job = made.edit([clip(made, "walk")], [{"command": "smooth", "frames": [2, 20]}], into="gaits/smooth")
    Marey_wait(made, job.id)
    clip(made, "turn").annotate("steps")
    gaits.commit("Smoothed walk")
    gaits.create_tag("v1")
    return made


def Marey_wait(project: ProjectHandle, job: str) -> None:
    from marey_client.jobs import Jobs

    Jobs(project.transport).wait(job, timeout_s=120)


def clip(project: ProjectHandle, name: str, collection: str | None = None) -> ClipHandle:
    (found,) = (one for one in project.clips.list(collection=collection) if one.name == name)
    return found


def gaits_of(project: ProjectHandle) -> DatasetHandle:
    return project.datasets.at("gaits")


def commands() -> list[list[str]]:
    return [shlex.split(line)[1:] for line in re.findall(r"^marey .*$", PAGE.read_text("utf-8"), re.MULTILINE)]


def tree(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_page(run: CommandLine, marey: Marey, project: ProjectHandle, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in commands():
        run(*command)
    studio = ProjectHandle(project.transport, "studio")
    try:
        names = {one.path for one in project.clips.list(collection="gaits")}
        assert {one.path for one in studio.clips.list()} == names
        for one in studio.clips.list():
            again = clip(project, one.name, one.item.collection)
            sent, kept = one.info(), again.info()
            for name in ("subject", "action", "licence", "consent_for", "comment"):
                assert getattr(sent, name) == getattr(kept, name), (one.path, name)
            assert one.item.tags == again.item.tags
            assert np.allclose(one.motion().poses, again.motion().poses, atol=1e-4)
        monkeypatch.chdir(run.folder)
        for example in re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL):
            exec(example, {"marey": marey})  # the examples of the page
        again = clip(studio, "walk", "again/raw")
        assert again.info().consent_for == ("research",)
        assert np.array_equal(again.motion().poses, clip(project, "walk", "gaits/raw").motion().poses)
    finally:
        studio.delete()
