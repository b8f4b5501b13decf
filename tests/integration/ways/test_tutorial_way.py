"""The tutorial `docs/tutorial/first-takes.md`: its commands run as printed, in their order."""

import re
import shlex
from collections.abc import Callable

import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import ROOT, blocks, commands_of

from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

PAGE = "docs/tutorial/first-takes.md"
BESIDE_MAREY = ("make ", ". ", "marey serve", "marey project create lab")
"""Beginnings of the lines that install, start the server, or create the project, which a fixture has done here."""


@pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session")
def test_every_command_of_the_tutorial_runs_as_printed(new_lab: Callable[[], ProjectHandle], run: CommandLine) -> None:
    new_lab()
    takes = run.folder / "takes"
    takes.mkdir()
    (takes / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.2, 1.0)))
    (takes / "other.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.2, 1.0, stature_m=1.6)))
    printed = [line for language, block in blocks(PAGE) for line in commands_of(language, block)]
    printed += re.findall(r"`(marey (?!--install)[a-z]+ [^`]+)`", (ROOT / PAGE).read_text(encoding="utf-8"))
    lines = [line for line in printed if not line.startswith(BESIDE_MAREY)]
    assert len(lines) >= 7, lines
    for line in lines:
        words = shlex.split(line.replace("~/takes", str(takes)))[1:]
        if "subfolder" not in line:
            run(*_of_the_listed_skeleton(words, run))
    assert [path.suffix for path in (run.folder / "out").rglob("walk*")] == [".bvh"]


def _of_the_listed_skeleton(words: list[str], run: CommandLine) -> list[str]:
    """Replace the name of the skeleton in a command by that of a skeleton in the project."""
    if "--to" not in words:
        return words
    listed = re.findall(r"^ ?(\S.*?)  +skeleton ", run("ls", "lab/skeletons").stdout, re.MULTILINE)
    assert len(listed) == 2, listed
    return [f"lab/skeletons/{listed[0]}" if word.startswith("lab/skeletons/") else word for word in words]
