"""Workflow of a user who looks at clips in a browser: the commands of the how-to page, on a real server."""

from __future__ import annotations

import re
import shlex
import stat
import webbrowser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import httpx
import pytest
from tests.support.command_line import CommandLine

from marey_client.project import ProjectHandle

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "look-at-motion.md"


def test_the_commands_of_the_page_give_addresses_whose_codes_open_the_project(
    run: CommandLine, project_with_version: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("retarget", "lab/gaits/raw/walk", "--to", "lab/skeletons/target", "--into", "studio")
    clips = {clip.path: clip.id for clip in project_with_version.clips.list()}
    walk, turn, studio = (clips[path] for path in ("gaits/raw/walk", "gaits/raw/turn", "studio/gaits/raw/walk"))
    opened: list[Path] = []

    def browse(url: str) -> bool:
        opened.append(Path(unquote(urlsplit(url).path)))
        return True

    monkeypatch.setattr(webbrowser, "open", browse)
    lines = re.search(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert lines is not None
    with_browser, *others = (shlex.split(line, comments=True)[1:] for line in lines[1].splitlines())

    done = run(*with_browser)
    (file,) = opened
    assert "mareyview_" not in done.stdout + done.stderr
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert f"/view?clip=lab/{walk}#mareyview_" in file.read_text()
    file.unlink()

    addresses = [urlsplit(run(*words).stdout.strip()) for words in others]
    assert [one.query for one in addresses] == [
        f"clip=lab/{walk}", f"clip=lab/{walk}&beside=lab/{turn}", f"clip=lab/{studio}&beside=lab/{walk}@1",
    ]  # fmt: skip
    with httpx.Client(base_url=f"{run.server.url}/api/v1", headers={"Sec-Fetch-Site": "same-origin"}) as browser:
        assert browser.get("/projects/lab/clips").status_code == 404
        assert browser.post("/browser-sessions", json={"code": addresses[0].fragment}).status_code == 201
        assert browser.get(f"/projects/lab/clips/{walk}/parts/motion").status_code == 200
    assert "0 clips that exist" in run("view", "lab/gaits/raw/walk", "--beside", "source", status=2).stderr
