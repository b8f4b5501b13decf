"""What everybody has who walks a way: a real server with a real worker, a client, a command line, a project."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from command_line import CommandLine
from evaluation_takes import write_walks
from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.imports import ImportOptions
from server_process import ServerProcess, serving


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    with serving(tmp_path, database_url) as process:
        yield process


@pytest.fixture
def marey(server: ServerProcess) -> Iterator[Marey]:
    """The first administrator's client."""
    with server.client() as client:
        yield client


@pytest.fixture
def run(server: ServerProcess, tmp_path: Path) -> CommandLine:
    return CommandLine(server, tmp_path)


@pytest.fixture
def lab_of(marey: Marey) -> Callable[..., ProjectHandle]:
    """Makes the project `lab` of these files and folders, in a collection."""

    def make(*paths: Path, collection: str = "walks") -> ProjectHandle:
        project = marey.create_project(ProjectCreate(name="lab"))
        project.imports.upload(find_files(sorted(paths)).files, ImportOptions(collection=collection))
        return project

    return make


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with nine walks: at three speeds, straight ahead and turning both ways."""
    return lab_of(write_walks(tmp_path / "takes"))
