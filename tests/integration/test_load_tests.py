"""Load tests of a running server: their measurements, and the removal of scratch projects and tokens."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.command_line import run_here
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import ALL_SCOPES, USER_SCOPES, Server

from marey_client.errors import Forbidden, MareyError
from marey_client.load import offering, scratch
from marey_client.load.measuring import LoadPlan, load_test
from marey_client.load.scratch import PREFIX, scratch_project
from marey_client.marey import Marey

QUICK = LoadPlan((20.0,), seconds=1.0, replicates=2, workers=2)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for the end of jobs than usual, because the machine may be busy."""
    monkeypatch.setattr(offering, "DRAIN_S", PATIENCE_S)


@pytest.fixture
def marey(server: Server) -> Iterator[Marey]:
    """The client of an administrator."""
    with Marey(server.address, server.make_user("ada", administrator=True, scopes=ALL_SCOPES)) as client:
        yield client


def left_behind(marey: Marey) -> list[str]:
    """Return the scratch projects and the tokens of scratch projects that exist."""
    projects = [one.name for one in marey.projects() if one.name.startswith(PREFIX)]
    return projects + [one.name for one in marey.tokens.list() if one.name.startswith(PREFIX)]


def test_every_job_is_counted_and_nothing_is_left_behind(marey: Marey) -> None:
    seen: list[str] = []
    (found,) = load_test(marey, QUICK, lambda what, _done, _total: seen.append(what))
    assert (found.unfinished, found.errors) == (0, {})
    assert found.submitted > 10
    assert 0 < found.start_ms["p50"].value <= found.start_ms["p95"].value <= found.start_ms["p99"].value
    assert found.server["processor_ms_per_job"] > 0
    assert "20/s, run 2 of 2" in seen
    assert left_behind(marey) == []


@pytest.mark.soak
def test_jobs_of_other_projects_are_not_claimed(marey: Marey) -> None:
    with scratch_project(marey) as other:
        waiting = marey.transport.send(
            "POST",
            f"/projects/{other.project.name}/jobs",
            content=json.dumps(other.job(own_workers=False)).encode(),
        ).json()["id"]
        list(load_test(marey, QUICK, lambda *_: None))
        job = marey.jobs.get(waiting)
        assert (job.state, job.fence) == ("queued", 0)


@pytest.mark.soak
def test_the_scratch_project_is_removed_after_ctrl_c_and_its_jobs_are_cancelled(marey: Marey) -> None:
    jobs: list[str] = []

    def interrupt(what: str, seconds: float, _total: float | None) -> None:
        if seconds > 0.5:
            (project,) = [one.name for one in marey.projects() if one.name.startswith(PREFIX)]
            jobs.extend(job.id for job in marey.project(project).jobs())
            if jobs:
                raise KeyboardInterrupt

    slow = LoadPlan((20.0,), seconds=5.0, replicates=1, workers=1, work_s=0.5)
    with pytest.raises(KeyboardInterrupt):
        list(load_test(marey, slow, interrupt))
    assert jobs
    assert left_behind(marey) == []


def test_a_server_without_workers_is_named_as_the_reason(marey: Marey, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offering, "DRAIN_S", 1.0)
    plan = LoadPlan((5.0,), seconds=1.0, replicates=1, workers=0)
    with pytest.raises(MareyError, match="marey worker ls"):
        list(load_test(marey, plan, lambda *_: None))
    assert left_behind(marey) == []


def test_error_answers_are_counted_by_request_and_code(marey: Marey, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "KIND", "no-such-kind")
    with pytest.raises(MareyError, match="submit: "):
        list(load_test(marey, LoadPlan((20.0,), seconds=1.0, replicates=1, workers=0), lambda *_: None))
    assert left_behind(marey) == []


def test_a_token_that_may_not_claim_jobs_is_refused_and_nothing_is_left(server: Server) -> None:
    with Marey(server.address, server.make_user("uma", scopes=USER_SCOPES)) as uma:
        with pytest.raises(Forbidden):
            list(load_test(uma, QUICK, lambda *_: None))
        assert left_behind(uma) == []


def test_users_who_are_not_administrators_get_figures_without_those_of_the_server(server: Server) -> None:
    with Marey(server.address, server.make_user("uma", scopes=ALL_SCOPES)) as uma:
        (found,) = load_test(uma, QUICK, lambda *_: None)
        assert (found.unfinished, found.server) == (0, {})


def test_the_command_prints_a_table_or_json(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    token = tmp_path / "token"
    token.write_text(server.make_user("ada", administrator=True, scopes=ALL_SCOPES))
    token.chmod(0o600)
    monkeypatch.setenv("MAREY_URL", server.address)
    options = ["bench", "load", "--rate", "20", "--seconds", "1", "--replicates", "1", "--token-file", str(token)]
    table = run_here(options)
    assert table.returncode == 0, table.stderr
    assert "start p50 ms" in table.stdout
    assert "ms of processor time" in table.stderr
    (found,) = json.loads(run_here([*options, "--json"]).stdout)["rates"]
    assert (found["rate"], found["unfinished"], found["start_ms"]["p50"]["margin"]) == (20.0, 0, None)
