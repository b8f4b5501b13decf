"""A project that all tests of a module share, because the contents of the project take long to create."""

from collections.abc import Iterator
from math import radians
from pathlib import Path

import pytest

from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.options.imports import ImportOptions

EXAMPLES = 12


@pytest.fixture(scope="module")
def lab(marey: Marey, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProjectHandle]:
    """A project with twelve aligned walks of two steps each, and two more walks that were aligned separately."""
    project = marey.create_project(ProjectCreate(name="lab"))
    folder = tmp_path_factory.mktemp("takes")
    write_steps(folder)
    project.imports.upload(find_files([folder]).files, ImportOptions(collection="walks"))
    clips = list(project.clips.list(collection="walks", sort="name"))
    marey.jobs.wait(project.align(clips, into="aligned").id)
    marey.jobs.wait(project.align(clips[:2], into="others").id)
    yield project
    project.delete()


def write_steps(folder: Path) -> None:
    """Write walks of two steps each as files, at different speeds, straight ahead and turning both ways."""
    for index in range(EXAMPLES):
        clip = generate_gait(1.0 + 0.05 * index, radians(10.0 * (index % 3 - 1)), 0.9)
        (folder / f"walk {index:02}.bvh").write_bytes(write_bvh(clip))
