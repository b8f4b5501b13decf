"""Workflow of a proposal with two users: the commands of the how-to page, on a real server."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.furnished_house import HIERARCHY, MOTION

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import Login, Role, UserCreate

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "review-a-change.md"


@pytest.mark.soak
@pytest.mark.parametrize("server", ["sqlite"], indirect=True)
def test_the_commands_of_the_page_work_in_their_order(
    run: CommandLine, marey: Marey, new_lab: Callable[[], ProjectHandle]
) -> None:
    project = new_lab()
    rig = project.skeletons.create("rig", {"hierarchy": HIERARCHY}).id
    poses = np.array([[0, 1, 0, 1, 0, 0, 0]], dtype="<f4")
    motion = {**MOTION, "poses": poses, "skeleton": {"item": rig, "revision": 1}}
    parts: dict[str, dict[str, Any]] = {"motion": motion, "info": {"schema": "marey/clip-info@1"}}
    walk = project.clips.create("walk", parts, collection="gaits/raw")
    marey.users.create(UserCreate(name="ben-of-the-proposal", password="a password of ben"))
    project.members.put("ben-of-the-proposal", Role.CONTRIBUTOR)
    token = marey.sign_in(Login(name="ben-of-the-proposal", password="a password of ben")).secret
    blocks = iter(re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))

    def follow(lines: list[str], **environment: str) -> list[str]:
        done = [run(*shlex.split(line)[1:], status=0, stdin="", **environment) for line in lines]
        return [" ".join((one.stdout + one.stderr).split()) for one in done]

    def change_walk(comment: str) -> None:
        walk.put_info(walk.info().model_copy(update={"comment": comment}))

    run("dataset", "create", "lab/gaits")
    run("dataset", "commit", "lab/gaits", "-m", "First takes")
    assert "contributor or higher, proposals, 1 approval, check evaluation" in follow(next(blocks).splitlines())[1]
    branch, checkout, commit, propose = next(blocks).splitlines()
    follow([branch, checkout])
    change_walk("a good take")
    assert "opened the proposal 1" in follow([commit, propose])[1]
    ls, show, diff, *rest = follow(next(blocks).splitlines(), MAREY_TOKEN=token)
    assert "Describe the walk" in ls
    assert "it has 0" in show
    assert "info changed" in diff
    assert "recorded the verdict request-changes" in rest[-1]
    change_walk("the left foot slides")
    follow([commit])
    follow(next(blocks).splitlines(), MAREY_TOKEN=token)
    (shown,) = follow(["marey proposal show lab/gaits 1"])
    assert "raw/walk (clip), frames 0:2 The left foot slides here" in shown
    assert "check evaluation succeeded Coverage 84 %" in shown
    (printed,) = json.loads(run("proposal", "show", "lab/gaits", "1", "--json").stdout)["comments"]
    assert printed["frames"] == [0, 2]
    merged, _ = follow(next(blocks).splitlines())
    assert "merged; main is at" in merged
    assert project.datasets.at("gaits").proposals.at(1).read().state == "merged"
    refused = run("dataset", "commit", "lab/gaits", "-m", "direct", status=1)
    assert "Nothing has changed" in refused.stderr
