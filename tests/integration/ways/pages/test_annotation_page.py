"""The how-to page about annotations and the pieces that are cut by them, run as printed."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import PrintedPage

from marey_client.project import ProjectHandle

pytestmark = [pytest.mark.soak, pytest.mark.timeout(300)]


@pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session")
def test_annotate_and_cut(
    empty_lab: ProjectHandle,
    add_walks: Callable[..., None],
    reads: Callable[..., PrintedPage],
    run: CommandLine,
    tmp_path: Path,
) -> None:
    add_walks("walks", "take", seconds=15.0)
    add_walks("hands", "reach", seconds=3.0)
    add_walks("takes", "walk", seconds=3.0)
    page = reads("docs/how-to/annotate-and-cut.md", names={"lab": empty_lab})
    page.follow(2)
    assert "12 step_left" in page.printed("marey annotation propose lab/walks")
    assert "made by person" in page.printed("marey annotation show")
    document = json.loads(run("annotation", "show", "lab/walks/take phases", "--json").stdout)
    assert [(one["label"], one["start"], one["end"]) for one in document["segments"]] == [
        ("idle", 0, 80),
        ("walk", 80, 300),
    ]
    assert document["keyframes"] == [{"label": "contact", "frame": 133}]
    page.names["clip_id"] = empty_lab.clips["hands/reach"].id
    page.follow(2)
    assert "steps/walks/step_left/take_step_left_01" in {clip.path for clip in empty_lab.clips}
    assert "1 reach" in page.printed("marey cut lab/hands")
    sections = {"walk": [{"start_idx": 0, "end_idx": 99}], "turn": [{"start_idx": 100, "end_idx": -1}]}
    (tmp_path / "take_sections.json").write_text(json.dumps({"sections": sections}))
    page.follow()
    document = json.loads(run("annotation", "show", "lab/walks/take old", "--json").stdout)
    assert document["segments"] == [
        {"label": "walk", "start": 0, "end": 100},
        {"label": "turn", "start": 100, "end": 450},
    ]
    exported = (tmp_path / "exchange" / "take phases_sections.json").read_text(encoding="utf-8")
    assert {"idle", "walk"} <= set(re.findall(r"\w+", exported))
