"""Workflow of comparing clips as people see them, with command line and SDK, on a real server with a real worker."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import QUICK as EVALUATION

from marey_client import Marey
from marey_client.errors import Invalid, JobUnsuccessful
from marey_client.handles.metrics import Distances, Metric
from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_schemas.documents.metrics import built_in_metric

pytestmark = pytest.mark.timeout(300)
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "compare-clips-as-people-see-them.md"
QUICK = {"evaluate": EVALUATION, "suggest": ("--estimation-replicates", "1", "--confirmation-replicates", "3")}
"""Options that shorten commands of the page."""


def test_the_commands_and_the_example_of_the_page_run(
    marey: Marey, lab: ProjectHandle, run: CommandLine, capsys: pytest.CaptureFixture[str]
) -> None:
    text = PAGE.read_text(encoding="utf-8")
    for clip, name in zip(list(lab.clips.list(sort="name"))[:2], ("slow", "fast"), strict=True):
        run("mv", f"lab/{clip.path}", f"lab/walks/{name}")
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [shlex.split(line, comments=True)[1:] for block in blocks for line in block.splitlines()]
    done = [run(*line, *QUICK.get(line[0], ())) for line in lines]
    assert "Only natural walks were judged." in done[0].stderr
    assert "metric: published/manhattan" in done[6].stdout
    assert "by the metric published/positions-sigmoid" in done[8].stdout
    info = next(iter(lab.processed.list())).part("info")
    assert info["metric"]["name"] == info["options"]["metric"] == "published/positions-sigmoid"
    (evaluated,) = lab.evaluations.list()
    assert evaluated.document()["perceived"]["transitions"] > 0
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(example, {"marey": marey})
    assert "(9, 9)" in capsys.readouterr().out


def test_two_walks_have_a_distance_with_maps_and_a_curve(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    one, other = (f"lab/{clip.path}" for clip in list(lab.clips.list(sort="name"))[:2])
    told = run(
        "metric", "compare", one, other, "--metric", "published/sigmoid", "--out", "pair.html", "--figures", "figures",
        "--maps", "maps.npz",
    )  # fmt: skip
    assert "metric: published/sigmoid" in told.stdout
    assert "Only natural walks were judged." in told.stderr
    page = (tmp_path / "pair.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")
    assert "What the metric can and cannot say" in page
    drawn = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {"registration.svg", "registration.png", "components.svg", "registration-curve.csv"} <= drawn
    with np.load(tmp_path / "maps.npz") as maps:
        parts = [maps[f"pair0_{name}"] for name in ("angles", "positions", "velocities")]
        np.testing.assert_allclose(maps["pair0_combined"], np.mean(parts, axis=0), rtol=1e-5)
        assert (np.diff(maps["pair0_curve_second_s"]) > 0).all()
    found = json.loads(run("metric", "compare", one, other, "--metric", "published/sigmoid", "--json").stdout)
    assert found["distances"][0][1] == found["distances"][1][0] > 0
    assert all(clip["cyclic"] and 0.6 <= clip["period_s"] <= 2.0 for clip in found["clips"])


def test_a_stored_metric_gives_the_distances_of_the_built_in_one(lab: ProjectHandle, run: CommandLine) -> None:
    assert "published/positions-manhattan" in run("metric", "ls").stdout
    run("metric", "store", "published/positions-manhattan", "lab/metrics/paper")
    assert "lab/metrics/paper" in run("metric", "ls", "lab").stdout
    assert ".429" in run("metric", "show", "lab/metrics/paper").stdout
    (stored,) = lab.metrics.list()
    assert stored.document() == built_in_metric("published/positions-manhattan")
    clips = list(lab.clips.list(sort="name"))[:3]

    def compared(metric: Metric) -> Distances:
        job = lab.distances(clips, metric=metric, report=False)
        return Distances(lab.transport, Jobs(lab.transport).wait(job.id))

    first, second = compared(stored), compared("published/positions-manhattan")
    np.testing.assert_array_equal(first.table(), second.table())
    assert first.summary["metric"] == second.summary["metric"]
    assert first.summary["nearest"]["distance"] == np.sort(first.table()[np.triu_indices(3, 1)])[0]
    assert not first.figures()


def test_what_cannot_be_compared_says_what_to_do(lab: ProjectHandle, run: CommandLine) -> None:
    clip = next(iter(lab.clips.list(sort="name")))
    told = run("metric", "compare", "lab/walks", "--metric", "published/power", status=2)
    assert "marey metric ls" in told.stderr
    with pytest.raises(JobUnsuccessful, match="at least two are needed"):
        Jobs(lab.transport).wait(lab.distances([clip]).id)
    parts = built_in_metric("uniform/manhattan").stored()
    with pytest.raises(Invalid, match="shares have the sum"):
        lab.metrics.create("odd", {"metric": {**parts, "components": parts["components"][:2]}})
