"""Workflow of a dataset: the commands of the how-to page, on a real server."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine

from marey_client.handles.clips import ClipHandle
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "version-a-dataset.md"


@pytest.fixture
def project(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with the clips `walk` and `turn` in the folder `gaits/raw`."""
    for name, step in (("walk", 0.5), ("turn", 0.6)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    return lab_of(tmp_path / "walk.bvh", tmp_path / "turn.bvh", collection="gaits/raw")


class Walker:
    """User who follows the how-to page, and changes clips between its commands."""

    def __init__(self, run: CommandLine, project: ProjectHandle) -> None:
        self.run = run
        self.project = project
        self.blocks = iter(re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))

    def follow(self, **placeholders: str) -> list[str]:
        """Run the commands of the next block of the page, and return the output of each command."""
        block = next(self.blocks)
        for text, value in placeholders.items():
            assert text in block
            block = block.replace(text, value)
        return [self.run(*shlex.split(line, comments=True)[1:]).stdout for line in block.splitlines()]

    def clip(self, name: str) -> ClipHandle:
        """Return the clip with this name in the folder of the dataset."""
        (found,) = (one for one in self.project.clips.list() if one.name == name)
        return found

    def comment(self, name: str, text: str) -> None:
        """Replace the comment in the description of a clip."""
        clip = self.clip(name)
        clip.put_info(clip.info().model_copy(update={"comment": text}))

    def commit(self, message: str, branch: str, comment: str) -> None:
        """Check out a branch, change the descriptions of the clips `walk` and `turn`, and commit."""
        self.run("dataset", "checkout", f"lab/gaits@{branch}")
        for name in ("walk", "turn"):
            self.comment(name, comment)
        self.run("dataset", "commit", "lab/gaits", "-m", message, "--branch", branch)


def test_the_commands_of_the_page_work_in_their_order(run: CommandLine, project: ProjectHandle) -> None:
    walker = Walker(run, project)
    gaits = project.datasets.at("gaits")
    walker.follow()
    walker.comment("turn", "a good take")
    run("dataset", "commit", "lab/gaits", "-m", "Describe the turn")
    run("tag", "lab/gaits/raw/walk", "--add", "slow")
    outputs = walker.follow()
    assert outputs[3].splitlines()[-2].split() == ["raw", "2", "changed"]
    assert outputs[4].splitlines()[-2:] == ["raw/turn:", "  info/comment added: a good take"]
    trimmed = gaits.at()
    walker.follow()
    assert walker.clip("walk").item.tags == ()
    branch, checkout, commit = next(walker.blocks).splitlines()
    for line in (branch, checkout):
        run(*shlex.split(line)[1:])
    walker.comment("walk", "on trial")
    run(*shlex.split(commit)[1:])
    for line in next(walker.blocks).splitlines():
        assert "the folder has 1 of 2 entries" in run(*shlex.split(line)[1:]).stderr
    assert [clip.name for clip in project.clips.list()] == ["turn"]
    walker.follow()
    assert (walker.clip("walk").item.tags, walker.clip("walk").info().comment) == (("slow",), "on trial")
    walker.commit("Theirs", "trial", "theirs")
    walker.commit("Ours", "main", "ours")
    assert "nothing was recorded" in run("dataset", "merge", "lab/gaits@trial", status=1).stderr
    walker.follow()
    exported, _ = walker.follow()
    assert json.loads(exported)["clips"] == 2
    assert sorted(path.name for path in (run.folder / "gaits-v1" / "raw").iterdir()) == ["turn.bvh", "walk.bvh"]
    (job,) = json.loads(run("job", "ls", "lab", "--json").stdout)
    assert gaits.at("v1").digest in run("job", "show", job["id"]).stdout
    run("dataset", "checkout", "lab/gaits")
    assert [walker.clip(name).info().comment for name in ("walk", "turn")] == ["ours", "theirs"]
    run("dataset", "checkout", "lab/gaits@trial")
    run("tag", "lab/gaits/raw/turn", "--add", "fast")
    run("dataset", "commit", "lab/gaits", "-m", "Tag the turn", "--branch", "trial")
    walker.follow(**{"1f3a9c07": trimmed.digest.removeprefix("sha256:")[:8]})
    run("dataset", "checkout", "lab/gaits")
    assert [walker.clip(name).item.tags for name in ("walk", "turn")] == [(), ("fast",)]
    assert gaits.at("trial") == gaits.at("v1")
    assert next(one.message for one in gaits.log(path="raw/walk")) == "Revert 'Trim the turns, drop the falls'"
