"""The how-to pages about the import, retargeting, export and editing of motion, run as printed."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import PrintedPage
from tests.support.short_walks import write_named_walks

from marey_client.project import ProjectHandle

Reads = Callable[..., PrintedPage]
AddWalks = Callable[..., None]

pytestmark = [
    pytest.mark.soak,
    pytest.mark.timeout(300),
    pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session"),
]


def test_import_motion(empty_lab: ProjectHandle, reads: Reads, run: CommandLine, tmp_path: Path) -> None:
    write_named_walks(tmp_path / "takes", "walk", "turn")
    write_named_walks(tmp_path, "dog")
    page = reads("docs/how-to/import-motion.md")
    page.follow(1)
    assert "2 files: 2 created" in page.printed("marey upload ~/takes")
    assert sorted(one.path for one in empty_lab.clips) == ["raw/turn", "raw/walk"]
    page.follow()
    assert "cm" in run("show", "lab/dog").stdout
    assert "no skeletons" in page.printed("marey skeleton merge lab")


def test_retarget(
    empty_lab: ProjectHandle, add_walks: AddWalks, name_skeletons: Callable[..., None], reads: Reads, run: CommandLine
) -> None:
    add_walks("raw", "walk", "turn", stature_m=1.70)
    add_walks("studio", "stand")
    name_skeletons("cmu-bvh (170 cm)", "mixamo (178 cm)")
    page = reads("docs/how-to/retarget.md")
    page.follow(1)
    assert "mixamo (178 cm)" in page.printed("marey ls lab/skeletons")
    made = {one.path: one.item.summary["skeleton"] for one in empty_lab.clips.list(collection="on-mixamo")}
    assert made == dict.fromkeys(
        ("on-mixamo/raw/walk", "on-mixamo/raw/turn"), empty_lab.skeletons["skeletons/mixamo (178 cm)"].id
    )
    assert "cmu-bvh (170 cm)" in run("show", "lab/raw/walk").stdout
    told = run("show", "--history", "lab/on-mixamo/raw/walk").stdout
    assert re.search(r" job_.*made from clip walk \(clip_\w+ revision 1\).*made from skeleton mixamo", told, re.DOTALL)
    page.follow()
    checks = run("show", "lab/on-mixamo/raw/walk").stdout
    assert "feet-kept" in checks
    assert "hands-kept" in checks
