"""Workflow of two teams: the commands of the how-to page, on two real servers."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import quick
from tests.support.server_process import ServerProcess, serving

from marey_client.archives import receiving, transfers
from marey_client.credentials import store_login
from marey_client.errors import Unreachable
from marey_client.handles.clips import ClipHandle
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "two-teams.md"


@pytest.fixture(scope="module")
def other_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """The server of the partner."""
    with serving(tmp_path_factory.mktemp("partner")) as process:
        yield process


@pytest.fixture
def partner(other_server: ServerProcess) -> Iterator[ProjectHandle]:
    """The project `lab` on the partner's server, without content."""
    with other_server.client() as client:
        project = client.create_project(ProjectCreate(name="lab"))
        yield project
        project.delete()


@pytest.fixture
def studio(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """The project `lab` with three clips in `gaits/raw`."""
    for name, step in (("walk", 0.5), ("turn", 0.6), ("fall", 0.7)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    return lab_of(*(tmp_path / f"{name}.bvh" for name in ("walk", "turn", "fall")), collection="gaits/raw")


@pytest.fixture
def told(run: CommandLine, server: ServerProcess, other_server: ServerProcess) -> Callable[..., str]:
    """Function that runs `marey` and returns its output.

    The user has logged in to both servers, and has no other token.
    """
    stored = run.folder / "marey" / "credentials.json"
    for process in (other_server, server):
        store_login(stored, process.url, process.token)

    def say(line: str, *, status: int = 0) -> str:
        line = line.replace("$PARTNER", other_server.url).replace("$STUDIO", server.url)
        done = run(*quick(shlex.split(line, comments=True)[1:]), status=status, MAREY_DATA=str(run.folder / "none"))
        return done.stdout + done.stderr

    return say


def blocks() -> list[list[str]]:
    """Return the lines of each block of commands on the page."""
    return [found.splitlines() for found in re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)]


def clip(project: ProjectHandle, name: str) -> ClipHandle:
    """Return the clip with this name."""
    (found,) = (one for one in project.clips.list() if one.name == name)
    return found


def test_two_teams_change_one_dataset_and_keep_the_work_of_both(
    told: Callable[..., str], run: CommandLine, studio: ProjectHandle, partner: ProjectHandle
) -> None:
    logins, share, theirs, ours, (pull, diff, merge), decide, results = blocks()
    assert all(line.startswith("marey --server $") and " login" in line for line in logins)
    for line in (*share, *theirs, *ours, pull):
        told(line)
    assert {"raw/fall", "raw/fall_back", "raw/turn", "raw/turn_left"} <= set(re.findall(r"raw/\w+", told(diff)))
    conflict = told(merge, status=1)
    assert "raw/walk" in conflict
    assert "raw/turn" not in conflict
    for line in decide:
        told(line)

    head = studio.datasets.at("gaits").at()
    assert len(head.parents) == 2
    assert [partner.datasets.at("gaits").at(version).digest for version in ("main", "v1")] == [head.digest] * 2
    partner.datasets.at("gaits").check_out()
    for project in (studio, partner):
        assert {one.name for one in project.clips.list()} == {"walk", "turn_left", "fall_back"}
        assert clip(project, "walk").info().action == "walk"
        assert len(clip(project, "walk").motion().poses) == len(clip(project, "turn_left").motion().poses) - 10
        assert {one.name for one in project.annotations.list()} >= {"walk steps", "turn steps", "fall steps"}
    for line in results:
        told(line)
    (job,) = (one for one in studio.jobs() if one.kind == "evaluate")
    assert head.digest in told(f"marey job show {job.id}")
    assert json.loads(run("archive", "verify", "gaits.tar", "--json").stdout)["commit"] == head.digest


def test_a_push_that_was_interrupted_continues_and_leaves_no_file(
    told: Callable[..., str],
    run: CommandLine,
    studio: ProjectHandle,
    partner: ProjectHandle,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    kept = run.folder / ".cache" / "marey" / "transfers"
    for line in blocks()[1][:2]:
        told(line)
    push = blocks()[1][2]

    def fail(*_args: object) -> None:
        raise Unreachable("the other server went away")

    with monkeypatch.context() as broken:
        broken.setattr(receiving._Import, "_send_commit", fail)
        told(push, status=1)
    assert [path.suffix for path in kept.iterdir()] == [".tar"]
    assert partner.datasets.at("gaits").ref("main").commit is None
    with monkeypatch.context() as counted:
        counted.setattr(transfers, "write_transfer", fail)  # the archive is there already
        told(push)
    assert list(kept.iterdir()) == []
    assert partner.datasets.at("gaits").at() == studio.datasets.at("gaits").at()
    assert "main of lab/gaits is at" in told(push)  # nothing is left to copy


def test_a_push_changes_no_branch_that_has_other_versions_and_no_tag(
    told: Callable[..., str], studio: ProjectHandle, partner: ProjectHandle
) -> None:
    for line in blocks()[1]:
        told(line)
    for project, text in ((studio, "ours"), (partner, "theirs")):
        project.datasets.at("gaits").check_out()
        walk = clip(project, "walk")
        walk.put_info(walk.info().model_copy(update={"comment": text}))
        project.datasets.at("gaits").commit(text)
        project.datasets.at("gaits").create_tag("v1")
    theirs = partner.datasets.at("gaits").at()
    answer = json.loads(told("marey dataset push lab/gaits@v1 --to $PARTNER --json"))
    head = studio.datasets.at("gaits").at()
    assert answer == {"commit": head.digest, "branch": "main", "moved": False, "tag": None}
    assert [partner.datasets.at("gaits").at(version) for version in ("main", "v1")] == [theirs] * 2
    pushed = told("marey dataset push lab/gaits --to $PARTNER")
    assert "was not moved; to merge them, run marey dataset merge lab/gaits@" in pushed
    assert "--into main --server http" in pushed
    told("marey dataset push lab/gaits --to $PARTNER --branch studio")
    assert partner.datasets.at("gaits").at("studio").digest == head.digest


def test_what_cannot_be_pushed_is_refused_with_a_remedy(
    told: Callable[..., str], run: CommandLine, studio: ProjectHandle, partner: ProjectHandle
) -> None:
    for line in blocks()[1][:2]:
        told(line)
    assert "copy the dataset to itself" in told("marey dataset push lab/gaits", status=2)
    assert "--other-token-file is for another server" in told(
        "marey dataset pull lab/gaits lab/copy --other-token-file token", status=2
    )
    assert "marey login" in told(f"marey dataset push lab/gaits --to {other_address(partner)}", status=1)
    assert "no branch, tag or commit" in told("marey dataset push lab/gaits@v9 --to $PARTNER", status=1)
    assert "not the address of a server" in told("marey dataset push lab/gaits --to partner", status=2)
    told("marey dataset pull lab/gaits lab/copy")  # on the same server
    assert studio.datasets.at("copy").at() == studio.datasets.at("gaits").at()


def other_address(project: ProjectHandle) -> str:
    """Return another address of the project's server, for which no login is stored."""
    return project.transport.url.replace("127.0.0.1", "localhost")
