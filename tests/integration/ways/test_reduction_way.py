"""Workflow from a collection to the clips of a study: the commands of the how-to page, on a real server."""

from __future__ import annotations

import csv
import json
import re
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.evaluation_takes import quick

from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "reduce-a-collection.md"
TEXT = PAGE.read_text(encoding="utf-8")
DURATIONS_S = {"take_02": 0.5, "take_10": 5.0, "take_12": 0.7}
"""Durations of the clips that are too short or too long; all other clips last 1.5 seconds."""


def blocks(language: str) -> list[list[str]]:
    """Return the lines of each code block of the page that is in this language."""
    return [found.splitlines() for found in re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)]


@pytest.fixture
def lab(new_lab: Callable[[], ProjectHandle], run: CommandLine) -> ProjectHandle:
    """The empty project `lab`. The folder in which commands run contains the takes and the table of the page."""
    (rows,) = blocks("csv")
    (run.folder / "takes.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (run.folder / "takes").mkdir()
    for number, row in enumerate(csv.DictReader(rows)):
        duration_s = DURATIONS_S.get(row["clip"], 1.5)
        motion = write_bvh(generate_gait(1.0 + 0.1 * number, 0.4 if row["action"] == "turn" else 0.0, duration_s))
        (run.folder / "takes" / f"{row['clip']}.bvh").write_bytes(motion)
    return new_lab()


def words_of(printed: str) -> list[list[str]]:
    """Return the cells of each row of a printed table, without the lines between rows."""
    rows = [re.split(r"\s{2,}", line.strip()) for line in printed.splitlines()]
    return [row for row in rows if row != [""] and not row[0].startswith("─")]


def test_the_page_leaves_out_clips_by_rules_and_says_later_why(run: CommandLine, lab: ProjectHandle) -> None:
    def follow(*lines: str) -> list[subprocess.CompletedProcess[str]]:
        return [run(*quick(shlex.split(line, comments=True)[1:])) for line in lines]

    def listed(line: str) -> list[Any]:
        (done,) = follow(f"{line} --json")
        return list(json.loads(done.stdout))

    begin, (explore,), *rules, look, change, measure = blocks("sh")
    explained, whole_log, log_of_take = (words_of("\n".join(block)) for block in blocks("text"))
    follow(*begin)
    assert words_of(follow(explore)[0].stdout) == explained
    assert "9 of 14 clips" in follow(explore)[0].stderr
    (preview, *_), *_ = (follow(*rule) for rule in rules)
    assert preview.stderr == "3 items would be removed; nothing was changed\n"
    kept = {one.name for one in lab.clips.list()}
    assert kept == {"take_01", "take_05", "take_07", "take_09", "take_13", "take_14"}

    log, log_of_path, blame_of_removed, diff, diff_of_path, blame = look
    commits, removed = listed(log), listed(log_of_path)[0]
    assert [[str(one["entries"]), one["message"]] for one in commits] == whole_log[1:]
    heading, *rows = words_of(follow(log_of_path)[0].stdout)
    assert [[row[heading.index("changes")], row[-1]] for row in rows] == log_of_take[1:]
    missing = run(*shlex.split(blame_of_removed)[1:], status=1).stderr
    assert f"it was removed by the commit {removed['digest']} ({removed['message']!r})" in missing
    assert "8 removed" in follow(diff)[0].stderr
    assert "1 removed" in follow(diff_of_path)[0].stderr
    assert "All recordings of walking" in follow(blame)[0].stdout
    (first, _) = listed("marey dataset log lab/walks@v5 --path take_10")
    assert first["message"].startswith("Leave out duration < 1 or duration > 4")

    follow(*change)
    assert {one.name for one in lab.clips.list()} == kept | {"take_11"}
    assert lab.datasets.at("walks").at("v5").digest == commits[0]["digest"]

    _, table, explained_use, *_ = follow(*measure)
    used = {one.name: one.item.facets for one in lab.clips.list()}
    assert used.keys() < kept | {"take_11"}, "the evaluation shows not all of the clips"
    assert all(facets["usage"] > 0 for facets in used.values())
    assert sum(facets["usage"] for facets in used.values()) == pytest.approx(1)
    assert all(name in table.stdout for name in kept)
    assert f"{len(used)} of {len(kept) + 1} clips" in explained_use.stderr
    assert listed("marey dataset log lab/walks")[0]["message"].startswith("Leave out facet.usage = 0")
