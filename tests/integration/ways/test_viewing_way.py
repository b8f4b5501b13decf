"""Workflow of a user who looks at clips in a browser: the commands of the how-to page, on a real server."""

from __future__ import annotations

import json
import re
import shlex
import stat
import webbrowser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import hatch_build
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
    pictures = re.search(r"```sh\n(marey view [^`]*?--out.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert pictures is not None
    turn_by = "rotate_joint joint=left_upper_arm angle_deg=60 axis=[0,0,1]"
    joint = project_with_version.clips["gaits/raw/walk"].motion(frames=slice(0, 1)).joints[5]
    run("edit", "apply", "lab/gaits/raw/walk", "--do", turn_by.replace("left_upper_arm", joint), "--in-place")
    drawn = [shlex.split(line, comments=True)[1:] for line in pictures[1].splitlines()]
    for words in (one for one in drawn if "models" not in one[1] and "eval" not in one[1]):
        name = words[words.index("--out") + 1]
        assert run(*words).stderr == f"wrote {name}\n"
        assert (run.folder / name).read_bytes().startswith(b"<?xml" if name.endswith(".svg") else b"\x89PNG")
    _write_pages(run)
    two = (run.folder / "change.svg").read_text(encoding="utf-8")
    assert re.findall(r">(revision \d)<", two) == ["revision 1", "revision 1", "revision 2"]  # legend and rows
    wrong = {
        ("--out", "x.gif"): "must end in .html, .png or .svg",
        ("--out", "x.png", "--frames", "9000:"): "contains no frame",
        ("--out", "x.png", "--frames", "a:b"): "not a range of frames", ("--frames", "1:2"): "no effect without --out",
        ("--out", "x.png", "--moments", "99"): "shows 1 to 24 moments",
        ("--out", "x.png", "-n", "2"): "no effect on a clip",
        ("--out", "x.html", "--moments", "2"): "no effect in a page",
    }  # fmt: skip
    for options, told in wrong.items():
        assert told in run("view", "lab/gaits/raw/walk", *options, status=2).stderr
    assert not list(run.folder.glob("x.*"))
    without_source = run("view", "lab/gaits/raw/turn", "--beside", "source", status=2).stderr
    assert "was not made from a clip that still exists; name a clip" in without_source


def _write_pages(run: CommandLine) -> None:
    """Write the pages of the how-to page from clips; a server without built pages refuses each with a remedy."""
    block = re.search(r"```sh\n(marey view [^`]*?walk[.]html.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None
    lines = [shlex.split(line, comments=True)[1:] for line in block[1].splitlines()]
    played = {}
    for words in (one for one in lines if "models" not in one[1] and "eval" not in one[1]):
        name = words[words.index("--out") + 1]
        if not (hatch_build.PAGES / "player.html").is_file():
            assert "offers no page that plays motion" in run(*words, status=1).stderr
            continue
        assert run(*words).stderr == f"wrote {name}\n"
        found = re.search(r'id="motion">(.*?)</script>', (run.folder / name).read_text(encoding="utf-8"))
        assert found is not None
        motions = json.loads(found[1])["motions"]
        played[name] = [(one["name"], one["frames"]) for one in motions]
    if not played:
        return
    ((path, frames),) = played["walk.html"]
    assert path == "gaits/raw/walk"
    assert played["part.html"] == [(path, 40)]
    assert played["retargeted.html"] == [(f"studio/{path}", frames), (path, frames)]
    assert played["change.html"] == [(f"{path}, revision 1", frames), (f"{path}, revision 2", frames)]
