"""Workflow of a comparison, with SDK and command line: the commands of the how-to page, on a real server."""

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

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "compare-revisions.md"


@pytest.fixture
def clip(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ClipHandle:
    """A walk with four revisions: imported, trimmed, and twice with another comment."""
    (tmp_path / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.5, 4.0)))
    project = lab_of(tmp_path / "walk.bvh", collection="raw")
    (made,) = project.clips.list()
    motion = made.motion()
    made.put_motion(motion.model_copy(update={"poses": motion.poses[12:]}), message="trimmed")
    made.put_info(made.info().model_copy(update={"comment": "a good take"}))
    copy = {name: made.part(name) for name in ("motion", "info")}
    project.clips.create("walk", copy, collection="clean")
    return made


def test_the_commands_of_the_page_compare_revisions_and_draw_them(run: CommandLine, clip: ClipHandle) -> None:
    block = re.search(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None
    outputs = [run(*shlex.split(line, comments=True)[1:]).stdout for line in block[1].splitlines()]
    assert outputs[0].splitlines() == ["walk: revision 2 → revision 3", "info/comment added: a good take"]
    assert "trimmed: first 12 frames removed (0.20 s)" in outputs[1].splitlines()
    assert outputs[2].splitlines() == ["walk revision 3 → walk revision 1", "no difference"]
    assert outputs[3] == outputs[1]
    assert (run.folder / "walk.png").read_bytes().startswith(b"\x89PNG")
    assert run("diff", "lab/raw/walk@1", "lab/raw/walk@2", "--picture", "walk.svg").stderr == "wrote walk.svg\n"
    assert b"<svg" in (run.folder / "walk.svg").read_bytes()


def test_earlier_revisions_are_shown_downloaded_and_returned_to(run: CommandLine, clip: ClipHandle) -> None:
    page = PAGE.with_name("keep-a-project-in-order.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"## Earlier revisions\n\n```sh\n(.*?)```", page, re.DOTALL)
    outputs = [run(*shlex.split(line, comments=True)[1:]) for line in block.splitlines()]
    assert "trimmed" in outputs[0].stdout
    assert "revision 1" in re.sub(r"[^\w]+", " ", outputs[1].stdout)
    assert outputs[-1].stderr == "raw/walk: revision 4 has the content of revision 1\n"
    assert len(clip.motion().poses) == len(clip.motion(revision=1).poses) == len(clip.motion(revision=2).poses) + 12
    assert "already" in run("revert", "lab/raw/walk@1").stderr
    assert json.loads(run("show", "lab/raw/walk@2", "--json").stdout)["message"] == "trimmed"
    assert "write project/folder/name@2" in run("revert", "lab/raw/walk", status=2).stderr
    assert "no revision 9" in run("show", "lab/raw/walk@9", status=1).stderr
    assert "there is no item" in run("show", "lab/raw/walk@x", status=2).stderr
    assert "is not the address of an item" in run("download", "lab/raw/walk@x", status=2).stderr


def test_the_difference_is_printed_as_json_and_returned_by_the_sdk(run: CommandLine, clip: ClipHandle) -> None:
    printed = json.loads(run("diff", "lab/raw/walk@2", "--threshold-deg", "5", "--json").stdout)
    found = clip.difference(1, 2, threshold_deg=5)
    assert printed == json.loads(found.model_dump_json(by_alias=True))
    assert found.motion is not None
    assert (found.motion.runs[0].change, found.motion.runs[0].before) == ("removed", (0, 12))
    assert clip.difference().parts == {"info": "changed"}


def test_wrong_arguments_are_explained(run: CommandLine, clip: ClipHandle) -> None:
    assert "no revision 9" in run("diff", "lab/raw/walk@9", status=1).stderr
    assert "there is no item at lab/raw/wlak" in run("diff", "lab/raw/wlak@1", status=2).stderr
    assert "must end in .svg or .png" in run("diff", "lab/raw/walk", "--picture", "walk.gif", status=2).stderr
    skeleton = run("ls", "lab", "--recursive", "--kind", "skeleton", "--json").stdout
    (body,) = json.loads(skeleton)["items"]
    other = f"lab/{body['collection']}/{body['name']}"
    assert "only items of one kind can be compared" in run("diff", "lab/raw/walk", other, status=2).stderr
    nothing = run("diff", "lab/raw/walk", "--picture", "walk.png")
    assert "nothing to draw" in nothing.stderr
    assert not (run.folder / "walk.png").exists()
