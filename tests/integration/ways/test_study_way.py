"""Workflow of a study: the commands and the Python of the how-to page, with simulated participants on a real server."""

from __future__ import annotations

import csv
import json
import re
import shlex
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess
from tests.support.studying import Participant, choice_by

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_motion.arrays import Floats

pytestmark = pytest.mark.timeout(600)

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "run-a-study.md").read_text(encoding="utf-8")
TRIALS = 21
"""Number of trials of each participant; the default of the page is three times as many."""


def commands() -> list[list[str]]:
    """Return the arguments of each command on the page, without `marey`, in the order of the page."""
    lines = [line.strip() for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line]


def by_speed(project: ProjectHandle, motions: list[str]) -> Floats:
    """Return differences of the walks that depend on their speeds, which are part of their names."""
    speeds = np.array([float(project.clips.get(item).name.split()[1]) for item in motions])
    return np.asarray(np.abs(speeds[:, None] - speeds[None]))


@pytest.mark.soak
def test_the_commands_of_the_page_lead_from_clips_to_a_metric(
    lab: ProjectHandle, run: CommandLine, server: ServerProcess, marey: Marey
) -> None:
    (run.folder / "consent.txt").write_text("I take part in this study.\n", encoding="utf-8")
    create, invite, status, listing, show, *exports, analyse, store, withdraw = commands()
    run(*create, "--trials", TRIALS)
    made = run(*invite)
    codes = re.findall(r"/s/#(mareystudy_\w+)", made.stdout)
    assert len(codes) == 3
    assert "never shows the links again" in made.stderr

    def connect(token: str | None) -> httpx.Client:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=f"{server.url}/api/v1", headers=headers, timeout=60)

    (study,) = lab.studies.list(collection="studies")
    design = study.design()
    true = by_speed(lab, [one.revision.item for one in design.motions])
    for number, code in enumerate(codes):
        Participant.begin(connect, code).answer_all(choice_by(true, 0.05, seed=number))
    assert re.search(r"finished +3\n", run(*status).stdout)
    assert "p3" in run(*listing).stdout

    assert show[-1] == "--browser"
    page = urlsplit(run(*show[:-1]).stdout.strip())
    assert (page.path, page.query) == ("/studies", f"study=lab/{study.id}")
    with httpx.Client(base_url=f"{server.url}/api/v1", headers={"Sec-Fetch-Site": "same-origin"}) as browser:
        assert browser.post("/browser-sessions", json={"code": page.fragment}).status_code == 201
        seen = browser.get(f"/projects/lab/studies/{study.id}/differences?revision=1").json()
        assert (seen["participants"], seen["trials"], len(seen["order"])) == (3, 3 * TRIALS, len(design.motions))
        assert browser.delete("/browser-sessions/lab").status_code == 204
        assert browser.get("/projects/lab").status_code in (401, 404)

    for export in exports:
        run(*export)
    rows = list(csv.DictReader((run.folder / "trials.csv").open(encoding="utf-8")))
    pairs = list(csv.DictReader((run.folder / "pairs.csv").open(encoding="utf-8")))
    people = json.loads((run.folder / "trials.json").read_text(encoding="utf-8"))
    assert (len(rows), len(pairs), len(people)) == (3 * TRIALS, 3 * TRIALS * 5, 3)
    assert {row["participant"] for row in rows} == {"p1", "p2", "p3"}

    printed = run(*analyse)
    metric = json.loads((run.folder / "metric.json").read_text(encoding="utf-8"))
    assert metric["schema"] == "marey/perceptual-metric@1"
    assert metric["study"] == {"item": study.id, "revision": 1}
    assert abs(sum(one["share"] for one in metric["components"]) - 1) < 1e-6
    assert (metric["fit"]["participants"], metric["fit"]["trials"]) == (3, 3 * TRIALS)
    report = (run.folder / "report.html").read_text(encoding="utf-8")
    assert "velocities, manhattan" in report
    assert "best rmse" in printed.stdout
    run(*store)
    (stored,) = lab.metrics.list(collection="metrics")
    assert stored.document().stored() == metric

    run(*withdraw)
    assert [one.state for one in study.participants()] == ["withdrawn", "finished", "finished"]
    assert [one.participant for one in study.judgements()] == ["p2", "p3"]
    block = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert block
    names: dict[str, Any] = {"marey": marey}
    exec(block[1], names)
    assert len(names["links"].links) == 2


def test_a_study_without_answers_cannot_be_analysed(lab: ProjectHandle, marey: Marey) -> None:
    study = lab.studies.design("small", list(lab.clips.list())[:4], consent_text="Yes.", trials=1)
    job = lab.submit(study.analyse_request())
    ended = marey.jobs.wait(job.id, timeout_s=300, require_success=False)
    assert ended.failure is not None
    assert "nobody has answered" in str(ended.failure)
