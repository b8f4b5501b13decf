"""The tutorial `docs/tutorial/first-takes.md`: its commands run as printed, in their order."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine

from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

PAGE = Path(__file__).parents[3] / "docs" / "tutorial" / "first-takes.md"
BESIDE_MAREY = ("make ", ". ", "marey serve", "marey project create lab")
"""Beginnings of the lines that install, start the server, or create the project, which a fixture has done here."""


@pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session")
def test_every_command_of_the_tutorial_runs_as_printed(new_lab: Callable[[], ProjectHandle], run: CommandLine) -> None:
    new_lab()
    takes = run.folder / "takes"
    takes.mkdir()
    (takes / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.2, 1.0)))
    (takes / "other.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.2, 1.0, stature_m=1.6)))
    text = PAGE.read_text(encoding="utf-8")
    printed = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    printed += re.findall(r"`(marey (?!--install)[a-z]+ [^`]+)`", text)
    lines = [line for line in printed if not line.startswith(BESIDE_MAREY)]
    assert len(lines) >= 7, lines
    for line in lines:
        words = shlex.split(line.replace("~/takes", str(takes)), comments=True)[1:]
        if "subfolder" not in line:
            run(*_of_the_listed_skeleton(words, run))
    assert [path.suffix for path in (run.folder / "out").rglob("walk*")] == [".bvh"]


def _of_the_listed_skeleton(words: list[str], run: CommandLine) -> list[str]:
    """Replace the example of a skeleton by a listed one, as the tutorial tells its readers to do."""
    if "--to" not in words:
        return words
    listed = re.findall(r"^ ?(\S.*?)  +skeleton ", run("ls", "lab/skeletons").stdout, re.MULTILINE)
    assert len(listed) == 2, listed
    return [f"lab/skeletons/{listed[0]}" if word.startswith("lab/skeletons/") else word for word in words]
