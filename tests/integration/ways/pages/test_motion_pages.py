"""The how-to pages about the import, retargeting, export and editing of motion, run as printed."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import PrintedPage
from tests.support.short_walks import write_named_walks

from marey_client import Marey
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


def test_export_motion(
    empty_lab: ProjectHandle, marey: Marey, add_walks: AddWalks, reads: Reads, tmp_path: Path
) -> None:
    add_walks("raw", "walk", "turn", seconds=2.0)
    (skeleton,) = empty_lab.skeletons
    empty_lab.retarget("raw", skeleton.id, into="on-mixamo").wait()
    empty_lab.align("raw", into="walk/aligned").wait()
    page = reads("docs/how-to/export-motion.md")
    page.follow(1)
    assert (tmp_path / "walk.bvh").read_bytes() == (tmp_path / "recorded" / "raw" / "walk.bvh").read_bytes()
    assert {file.name for file in (tmp_path / "out").rglob("*.bvh")} == {"walk.bvh", "turn.bvh"}
    page.follow()
    assert "on-mixamo/raw/turn 30.0 (60, 2, 4) (60, 3)" in page.printed("from marey_client")


def test_edit_motion(
    empty_lab: ProjectHandle, marey: Marey, add_walks: AddWalks, reads: Reads, run: CommandLine
) -> None:
    add_walks("takes", "walk", "run", seconds=10.0)
    page = reads("docs/how-to/edit-motion.md")
    page.follow(1)
    assert "concatenate" in page.printed("marey edit commands")
    assert "window_s" in page.printed("marey edit commands smooth")
    assert "240" in page.printed("marey edit preview")
    page.follow(1)
    assert [clip.path for clip in empty_lab.clips.list(sort="name", collection="clean")] == [
        "clean/takes/run", "clean/takes/walk"
    ]  # fmt: skip
    walk = empty_lab.clips["takes/walk"]
    assert (walk.item.revision, empty_lab.clips["takes/walk-mirrored"].frames) == (2, walk.frames)
    page.follow()
    assert "(100, 26, 3)" in page.printed("from marey_client")
    assert "Studio takes 0 trim start=30" in page.printed("marey edit show lab/edits/clean-up")
    assert "trim" in (run.folder / "clean-up.json").read_text(encoding="utf-8")
    for job in list(empty_lab.jobs()):
        assert marey.jobs.wait(job.id).state == "succeeded"
    assert empty_lab.clips["joined/takes/walk"].frames > 300
    run("edit", "apply", "lab/takes/walk", "--do", "cut_loop", "--into", "loops", "--tag", "loop")
    assert empty_lab.clips["loops/takes/walk"].item.tags == ("loop",)
