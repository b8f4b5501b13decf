"""Workflow from an evaluation to a better set of clips, with command line and SDK, on a real server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.errors import JobUnsuccessful
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.project import ProjectHandle
from marey_schemas.access import Login, Role, UserCreate
from marey_schemas.queue.jobs import CollectionInput, JobCreate

pytestmark = pytest.mark.timeout(300)

SMALL: dict[str, Any] = {
    "speeds_m_s": (1.0, 1.5), "turn_rates_deg_s": (-50.0, 0.0, 50.0), "families": ("circle",), "duration_s": 6.0,
    "baseline": False, "report": False, "replicates": 1,
}  # fmt: skip

FEW = ("--estimation-replicates", 1, "--confirmation-replicates", 3)


def evaluated(lab: ProjectHandle, clips: Any = "walks", **options: Any) -> EvaluationHandle:
    return lab.evaluation(lab.evaluate(clips, **{**SMALL, **options}))


@pytest.mark.soak
def test_without_all_that_can_go_no_trial_changes(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    first = evaluated(lab, name="first")
    told = run("suggest", "lab/first", "--removals", 1, "--remove-out", "names.txt", *FEW).stdout
    names = (tmp_path / "names.txt").read_text(encoding="utf-8").splitlines()
    unused = {clip["clip"] for clip in first.clips() if clip["ticks"] == 0}
    assert names
    assert set(names) <= unused
    assert "can be removed without changing any trial." in told
    kept = [clip for clip in lab.clips.list() if clip.path not in names]
    evaluated(lab, kept, name="second", normaliser=first.id)

    told = run("compare", "lab/first", "lab/second", "--out", "compared.html").stdout
    assert "No trial changed: the results of all 6 trials are identical, bit for bit." in told
    assert f"removed: {len(names)} clips" in told
    page = (tmp_path / "compared.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")
    assert "https://" not in page.partition("</head>")[0]
    found = json.loads(run("compare", "lab/first", "lab/second", "--json").stdout)
    assert found["changed"] == []
    assert {one["verdict"] for one in found["metrics"]} == {"same"}


@pytest.mark.soak
def test_a_used_clip_that_goes_is_found_to_change_trials(lab: ProjectHandle) -> None:
    first = evaluated(lab, name="first", replicates=3)
    most = max(first.clips(), key=lambda clip: clip["ticks"])["clip"]
    second = evaluated(
        lab,
        [clip for clip in lab.clips.list() if clip.path != most],
        name="second",
        normaliser=first.id,
        replicates=3,
    )
    compared = first.compare(second)
    document = compared.document()
    assert compared.summary["changed_trials"] == len(document["changed"]) > 0
    assert len(document["removed"]) == 1
    own = next(change for change in document["metrics"] if change["metric"] == "offset_mean")
    assert own["replicates"] == 3
    assert own["low"] <= own["change"] <= own["high"]
    assert compared.report().startswith(b"<!DOCTYPE html>")


def test_evaluations_under_their_own_normalisers_are_refused_with_the_way_out(
    lab: ProjectHandle, run: CommandLine
) -> None:
    first = evaluated(lab, name="first")
    some = sorted(lab.clips.list(), key=lambda clip: clip.path)[:6]
    second = evaluated(lab, some, name="second")
    with pytest.raises(
        JobUnsuccessful, match=r"normalisers differ.*`marey evaluate … --normaliser PROJECT/first`"
    ) as refused:
        first.compare(second)
    assert refused.value.job.failure is not None
    assert refused.value.job.failure.code == "not-comparable"
    assert "--normaliser" in run("compare", "lab/first", "lab/second", status=1).stderr


def test_clips_of_another_folder_fill_the_holes_of_a_set(lab: ProjectHandle, marey: Marey, run: CommandLine) -> None:
    straight = [clip for clip in lab.clips.list() if clip.name.endswith(" 0")]
    first = evaluated(lab, straight, name="straight")
    found = first.suggest("walks", removals=0, consider=0, confirmation_replicates=0).document()
    names = {one["name"] for one in found["fillings"]}
    assert names
    assert all("60" in name for name in names)
    assert not any(one["needs_retarget"] for one in found["fillings"])
    told = run(
        "suggest",
        "lab/straight",
        "--from",
        "lab/walks",
        "--removals",
        0,
        "--consider",
        0,
        "--confirmation-replicates",
        0,
    ).stdout
    assert f"{len(found['fillings'])} clips would fill gaps in the coverage." in told
    assert "can be blended with the set" in told

    run("optimise", "lab/straight", "--from", "lab/walks", "--max-steps", 2, "--consider", 3, *FEW)
    (job,) = [one for one in lab.jobs() if one.kind == "optimise"]
    log = b"".join(marey.jobs.log(job.id))
    steps = [line for line in log.decode().splitlines() if line.startswith("step ")]
    assert len(steps) == present(job.result)["steps"] + 1
    assert present(job.result)["objective_after"] < present(job.result)["objective_before"]


def test_weights_are_swept_over_tasks(lab: ProjectHandle, run: CommandLine) -> None:
    first = evaluated(lab, name="first")
    found = first.sweep(factors=(0.5,), estimation_replicates=1, confirmation_replicates=0)
    assert found.job.size == 8
    document = found.document()
    weights = [setting["weights"] for setting in document["settings"]]
    differing = [[name for name in weights[0] if one[name] != weights[0][name]] for one in weights]
    assert differing[0] == []
    assert all(len(names) == 1 for names in differing[1:])
    assert {one["group"] for one in document["influences"]} == {name for (name,) in differing[1:]}
    assert "The objective is" in run("sweep", "lab/first", "--factors", "0.5", *FEW).stdout


def test_who_may_read_the_project_may_read_the_files_that_its_results_name(
    lab: ProjectHandle, marey: Marey, server: ServerProcess
) -> None:
    """Results of jobs refer to the files, so a reader may read files that others have uploaded."""
    first = evaluated(lab, name="first")
    exported = lab.submit(JobCreate(kind="export", inputs={"clips": (CollectionInput(collection="walks"),)}))
    archive = marey.jobs.wait(exported.id).result
    compared = first.compare(first)
    assert archive is not None
    marey.users.create(UserCreate(name="rita", password="a password of rita"))
    lab.members.put("rita", Role.READER)
    with Marey(server.url) as nobody:
        token = nobody.sign_in(Login(name="rita", password="a password of rita")).secret
    with Marey(server.url, token) as rita:
        assert len(rita.blobs.fetch(archive["archive"]["blob"])) == archive["archive"]["size_bytes"]
        for name in ("document", "report"):
            rita.blobs.fetch(present(compared.job.result)[name]["blob"])
