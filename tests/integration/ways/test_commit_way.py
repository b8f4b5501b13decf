"""Workflow of results that a job commits: the commands of the how-to page, on a real server with a real worker."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine

from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_schemas.datasets.commits import PutEntry
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import CollectionInput, ItemInput, Job, JobCreate
from marey_schemas.queue.pipelines import PipelineCreate

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "commit-results.md"


@pytest.fixture
def project(project_with_version: ProjectHandle) -> ProjectHandle:
    return project_with_version


def test_the_commands_of_the_page_commit_results(run: CommandLine, project: ProjectHandle) -> None:
    page = PAGE.read_text(encoding="utf-8")
    simple, placed, conflict = (
        [shlex.split(line, comments=True)[1:] for line in block.splitlines()]
        for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    )
    gaits = project.datasets.at("gaits")
    made, log, blame = (run(*line) for line in simple)
    job = gaits.at().job
    assert job is not None
    assert f"gaits@main is at {gaits.at().digest.removeprefix('sha256:')[:12]} now" in made.stderr
    assert job in log.stdout
    assert blame.stdout.count(job) == 8  # in the columns of jobs and of messages
    assert gaits.at().digest in run("job", "show", job).stdout

    *_, entries = (run(*line).stdout for line in placed)
    assert re.findall(r"target/\S+", entries) == ["target/gaits/raw/walk"]
    messages = [one.message for one in gaits.log("trial")]
    assert messages[1:3] == ["Walks on the target", f"Results of retarget {job}"]

    assert "/commit/branch" in run(*simple[0][:-1], "gaits@v1", status=1).stderr
    late = submit_after_others(project)
    (walk,) = (one for one in project.clips.list() if one.path == "studio/gaits/raw/walk")
    walk.put_info(walk.info().model_copy(update={"comment": "by hand"}))
    gaits.commit("By hand", changes=[PutEntry(path="studio/gaits/raw/walk", item=walk.id)])
    by_hand = gaits.at()
    ended = Jobs(project.transport).wait(late.id)
    assert ended.publish_conflict is not None
    assert ended.publish_conflict.branch == late.id
    assert gaits.at() == by_hand
    preview, decide = ([word.replace("JOB", late.id) for word in line] for line in conflict)
    assert "studio/gaits/raw/walk" in run(*preview, status=1).stdout
    run(*decide)
    assert set(gaits.at().parents) == {by_hand.digest, gaits.at(late.id).digest}


def submit_after_others(project: ProjectHandle) -> Job:
    """Submit a job that commits its results, and return the job.

    It starts after several other jobs, so another user has time to commit before it.
    """
    (rig,) = (one for one in project.skeletons.list() if one.name == "target")
    inputs = {"clips": (CollectionInput(collection="gaits/raw"),), "skeleton": ItemInput(item=rig.id)}
    before: tuple[str, ...] = ()
    for _ in range(3):
        before = (
            project.submit(JobCreate(kind="export", inputs={"clips": inputs["clips"]}, after=before, cache="off")).id,
        )
    return project.submit(
        JobCreate(
            kind="retarget", inputs=inputs, params={"scale": 0.5}, into="studio", after=before,
            commit=OutputsCommit.at("gaits"),
        )
    )  # fmt: skip


def test_the_steps_of_a_pipeline_commit_what_they_make(project: ProjectHandle) -> None:
    (rig,) = (one for one in project.skeletons.list() if one.name == "target")
    pipeline = PipelineCreate.model_validate(
        {
            "steps": {
                "move": {
                    "kind": "retarget",
                    "inputs": {"clips": {"collection": "gaits/raw"}, "skeleton": {"item": rig.id}},
                },
                "files": {"kind": "export", "inputs": {"clips": {"step": "move"}}},
            },
            "into": "piped",
            "commit": OutputsCommit.at("gaits"),
        }
    )
    steps = project.pipeline(pipeline).wait()
    commit = steps["move"].commit
    assert commit is not None
    assert steps["files"].commit is None
    assert project.datasets.at("gaits").at().digest == commit.digest
