"""The how-to pages that lead from takes to a model, and about its report, run as printed."""

import re
import webbrowser
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import write_walks
from tests.support.printed_pages import PrintedPage

from marey_client.project import ProjectHandle

Reads = Callable[..., PrintedPage]

pytestmark = [
    pytest.mark.soak,
    pytest.mark.timeout(600),
    pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session"),
]


def test_from_takes_to_a_model(empty_lab: ProjectHandle, reads: Reads, run: CommandLine, tmp_path: Path) -> None:
    write_walks(tmp_path / "marey-demo" / "generated", seconds=4.0)
    page = reads(
        "docs/how-to/from-takes-to-a-model.md",
        left_out={
            ". .venv/bin/activate": "changes the shell",
            "marey project create lab": "a fixture has created the project",
        },
    )
    page.follow(3)
    assert re.search(r"\d+ examples ", page.printed("marey build-model"))
    assert (tmp_path / "step-left.html").read_bytes().startswith(b"<!DOCTYPE html>")
    page.follow(1)
    assert len(list((tmp_path / "samples").glob("*.bvh"))) == 5
    assert len(list(empty_lab.clips.list(collection="step-left/samples"))) == 5
    page.follow(1)
    assert (tmp_path / "step.bvh").read_bytes().startswith(b"HIERARCHY")
    page.follow()
    assert (tmp_path / "step-right.html").read_bytes().startswith(b"<!DOCTYPE html>")
    assert page.names["model"].path == "step-left/step-left"
    assert len(page.names["samples"].motions) == 10


def test_read_a_model_report(
    empty_lab: ProjectHandle, reads: Reads, run: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_walks(tmp_path / "takes", seconds=1.5)
    run("upload", "takes", "--project", "lab", "--collection", "raw")
    run("align", "lab/raw", "--into", "aligned")
    run("model", "lab/aligned", "--name", "raise", "--into", "models")
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    page = reads("docs/how-to/read-a-model-report.md")
    page.follow()
    assert [Path(address).name for address in opened] == ["raise.html"]
    written = {file.name for file in (tmp_path / "figures").iterdir()}
    assert {f"samples.{form}" for form in ("png", "svg", "json")} <= written
    assert any(name.endswith(".csv") for name in written)
    untested = ("--input", "aligned=aligned", "--param", "search_check=false")
    run("job", "submit", "lab", "model", *untested)
