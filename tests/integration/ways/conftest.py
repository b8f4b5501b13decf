"""Fixtures of the tests of user workflows: a real server with a real worker, a client, a command line and a project.

Starting a server takes longer than most workflows. So all workflows share one server per kind of database, and each has
a new project `lab`. The project is deleted after the test, which hides its contents and frees its name.
"""

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.database_fixtures import BACKENDS, copied_sqlite, database_address, new_postgres_database
from tests.support.evaluation_takes import write_walks
from tests.support.server_process import ServerProcess, serving

from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.options.imports import ImportOptions


@pytest.fixture(scope="session")
def script_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder whose Git repositories the server and its worker allow for scripts."""
    return tmp_path_factory.mktemp("repositories")


@pytest.fixture
def script_repositories(script_folder: Path) -> Path:
    """A folder for the Git repositories of one test."""
    return Path(tempfile.mkdtemp(dir=script_folder))


@pytest.fixture(scope="session", params=BACKENDS)
def server(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, script_folder: Path
) -> Iterator[ServerProcess]:
    """A server that all tests with one kind of database share."""
    folder = tmp_path_factory.mktemp("server")
    with contextlib.ExitStack() as after:
        if request.param == "sqlite":
            url = copied_sqlite(request.getfixturevalue("sqlite_template"), folder)
        else:
            postgres = request.getfixturevalue("postgres_url")
            url = database_address(after.enter_context(new_postgres_database(postgres, "ways")))
        yield after.enter_context(
            serving(folder, url, MAREY_SCRIPT_REPOSITORIES=json.dumps([f"file://{script_folder}/"]))
        )


@pytest.fixture(scope="session")
def marey(server: ServerProcess) -> Iterator[Marey]:
    """The client of the first administrator."""
    with server.client() as client:
        yield client


@pytest.fixture
def new_lab(marey: Marey) -> Iterator[Callable[[], ProjectHandle]]:
    """Function that creates the project `lab`, which is deleted after the test."""
    with contextlib.ExitStack() as after:

        def make() -> ProjectHandle:
            project = marey.create_project(ProjectCreate(name="lab"))
            after.callback(project.delete)
            after.callback(cancel_jobs, marey, project)
            return project

        yield make


def cancel_jobs(marey: Marey, project: ProjectHandle) -> None:
    """Cancel the remaining jobs of a test, so that they do not occupy the worker during the next test."""
    left = [job for job in project.jobs() if not job.state.terminal]
    for job in left:
        marey.jobs.cancel(job.id)
    for job in left:
        marey.jobs.wait(job.id, timeout_s=120, require_success=False)


@pytest.fixture
def run(server: ServerProcess, tmp_path: Path) -> CommandLine:
    return CommandLine(server, tmp_path)


@pytest.fixture
def lab_of(new_lab: Callable[[], ProjectHandle]) -> Callable[..., ProjectHandle]:
    """Function that creates the project `lab` and imports files and folders into one folder of the project."""

    def make(*paths: Path, collection: str = "walks") -> ProjectHandle:
        project = new_lab()
        project.imports.upload(find_files(sorted(paths)).files, ImportOptions(collection=collection))
        return project

    return make


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with nine walks: at three speeds, straight ahead and turning both ways."""
    return lab_of(write_walks(tmp_path / "takes"))


@pytest.fixture
def project_with_version(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with two clips in `gaits/raw`, a skeleton `target`, and the version `v1` of the dataset `gaits`."""
    for name, step in (("walk", 0.5), ("turn", 0.6)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 3.0)))
    project = lab_of(tmp_path / "walk.bvh", tmp_path / "turn.bvh", collection="gaits/raw")
    (rig,) = project.skeletons.list()
    project.skeletons.create("target", {"hierarchy": rig.part("hierarchy")}, collection="skeletons")
    gaits = project.datasets.create("gaits", collection="gaits")
    gaits.commit("First version")
    gaits.create_tag("v1")
    return project
