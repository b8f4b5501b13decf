"""Workflow of measuring the quality of motion, with command line and SDK, on a real server with a real worker."""

from __future__ import annotations

import csv
import json
import re
import shlex
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine

from marey_client import Marey
from marey_client.project import ProjectHandle

pytestmark = pytest.mark.timeout(300)
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "measure-the-quality-of-motion.md"


def test_the_commands_and_the_example_of_the_page_run(
    marey: Marey,
    lab: ProjectHandle,
    run: CommandLine,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    done = [run(*shlex.split(line, comments=True)[1:]) for line in lines]
    assert "foot skate, weighted by height" in done[1].stdout
    assert "difference" in done[1].stdout
    assert (tmp_path / "quality.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with (tmp_path / "quality.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["role"] for row in rows] == ["clip"] * 9 + ["reference"] * 9
    assert {"clips.svg", "travel.png", "clips-clips.csv"} <= {path.name for path in (tmp_path / "figures").iterdir()}
    listed = [float(value) for value in re.findall(r" (0\.\d+) ", done[2].stdout)]
    assert listed == sorted(listed, reverse=True)
    assert "smoothed" in done[3].stdout
    document = json.loads(done[4].stdout)
    assert document["conditions"]["options"]["rate_hz"] == 25.0
    assert document["reference"] is None

    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(example, {"marey": marey})
    assert "value=" in capsys.readouterr().out

    slow = next(job for job in lab.jobs() if job.kind == "quality" and job.params["rate_hz"] == 25.0)
    clip = next(iter(lab.clips.list(collection="walks")))
    segments = [{"label": "contact_both", "start": 0, "end": 30}]
    labels = {"clip": {"item": clip.id, "revision": clip.item.revision}, "segments": segments}
    lab.annotations.create("contacts", {"annotation": {"schema": "marey/annotation@1", **labels}}, collection="labels")
    told = run(
        "quality", f"lab/{clip.path}", "--contacts", "lab/labels", "--no-report", "--against", slow.id, status=1
    )  # fmt: skip
    assert "contacts is detected and annotated" in told.stderr
    assert "rate_hz is 25.0 and 30.0" in told.stderr
    assert "`marey quality … --rate-hz 25.0 --floor zero --draws 1000 --seed 0`" in told.stderr
    same = run("quality", "lab/walks", "--no-report", "--rate-hz", 25, "--floor", "zero", "--against", slow.id)
    assert "earlier" in same.stdout
    waiting = run("quality", "lab/walks", "--no-wait", "--csv", "x.csv", status=2)
    assert "leave out --no-wait" in waiting.stderr
