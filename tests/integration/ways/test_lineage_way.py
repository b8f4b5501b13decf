"""Workflow of a user who traces what a result was made from: the commands of the how-to page, on a real server."""

from __future__ import annotations

import json
import re
import shlex
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import quick

from marey_client.project import ProjectHandle

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "trace-a-result.md"


@pytest.fixture
def project(project_with_version: ProjectHandle) -> ProjectHandle:
    return project_with_version


def test_the_commands_of_the_page_trace_results_and_outdated_inputs(
    run: CommandLine, project: ProjectHandle, tmp_path: Path
) -> None:
    page = PAGE.read_text(encoding="utf-8").replace("lineage.svg", str(tmp_path / "lineage.svg"))
    made, inputs, exported, outdated = (
        [quick(shlex.split(line, comments=True)[1:]) for line in block.splitlines()]
        for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    )
    for line in made:
        run(*line)
    head = project.datasets.at("gaits").at("v1").digest
    (told,) = (run(*line).stdout.splitlines() for line in inputs)
    shown = re.search(r"```\n(target-v1.*?)```", page, re.DOTALL)
    assert shown is not None
    assert [without_ids(line) for line in told] == [without_ids(line) for line in shown[1].splitlines()]
    assert head.removeprefix("sha256:")[:12] in told[3]

    _, graph = (run(*line).stdout for line in exported)
    assert ElementTree.parse(tmp_path / "lineage.svg").getroot().tag.endswith("svg")
    kinds = [(one["kind"], one["distance"]) for one in json.loads(graph)["revisions"]]
    assert sorted(kinds[1:]) == [("clip", 1), ("evaluation", 2)]
    assert json.loads(graph)["jobs"][0]["commits"] == [head]

    (walk,) = (clip for clip in project.clips.list() if clip.path == "gaits/raw/walk")
    walk.put_info(walk.info().model_copy(update={"comment": "limps"}))
    stale, lineage = (run(*line).stdout for line in outdated)
    assert "target-v1" in stale
    assert "2 clips in gaits/raw (1 with a newer revision)" in lineage


def without_ids(line: str) -> str:
    return re.sub(r"job_[0-9a-z]{26}|(?<=commit )[0-9a-f]{12}", "…", line)


def test_a_graph_of_the_command_line_is_limited_and_refuses_other_files(
    run: CommandLine, project: ProjectHandle, tmp_path: Path
) -> None:
    assert "no item" in run("lineage", "lab/nothing", status=2).stderr
    assert ".svg, .png or .dot" in run("lineage", "lab/gaits/raw/walk", "--picture", "lineage.pdf", status=2).stderr
    assert "no revision 7" in run("lineage", "lab/gaits/raw/walk@7", status=1).stderr
    run("lineage", "lab/gaits/raw/walk", "--picture", str(tmp_path / "walk.dot"))
    assert (tmp_path / "walk.dot").read_text().startswith("digraph lineage {")
    rig = project.skeletons.list()
    assert all(one.lineage_graph(direction="inputs").links == () for one in rig)
