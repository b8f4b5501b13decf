"""The pages for programmers and the front page, run as printed."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.evaluation_takes import write_walks
from tests.support.printed_pages import ROOT, PrintedPage
from tests.support.server_process import ServerProcess
from tests.support.short_walks import write_named_walks
from tests.support.webhook_receiver import Open

from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle

Reads = Callable[..., PrintedPage]
AddWalks = Callable[..., None]

pytestmark = [
    pytest.mark.soak,
    pytest.mark.timeout(900),
    pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session"),
]


@pytest.mark.curl
def test_use_rest(
    empty_lab: ProjectHandle, server: ServerProcess, add_walks: AddWalks, reads: Reads, tmp_path: Path
) -> None:
    add_walks("rigs", "rig", stature_m=1.70)
    (skeleton,) = empty_lab.skeletons
    write_named_walks(tmp_path, "walk", seconds=5.0)
    page = reads("docs/how-to/use-rest.md", replaced={"http://127.0.0.1:8460": server.url, "SKELETON": skeleton.id})
    page.follow(1)
    listed = 'curl -sSG -H "$authorization" "$api/projects/lab/clips"'
    (found,) = json.loads(page.printed(f"{listed} --data-urlencode"))["items"]
    assert json.loads(page.printed(f"{listed} -d collection=raw"))["items"] == [found]
    assert json.loads(page.printed('curl -sS -H "$authorization" "$api/me"'))["user"]["name"] == "admin"
    clip = empty_lab.clips["raw/walk"]
    submitted = empty_lab.retarget("raw", skeleton.id, into="earlier")
    page.replaced = {**page.replaced, "CLIP": clip.id, "JOB": submitted.id}
    page.follow(1)
    motion = json.loads(page.printed('curl -sS -H "$authorization" "$api/projects/lab/clips/CLIP/parts/motion'))
    assert motion["poses"]["shape"] == [100, 11]
    assert (tmp_path / "back.bvh").read_bytes().startswith(b"HIERARCHY")
    assert json.loads(page.printed("curl -sS -X POST"))["kind"] == "retarget"
    assert json.loads(page.printed("curl -sS -H \"$authorization\" -H 'Prefer: wait=20'"))["state"] == "succeeded"
    assert "walks/raw/walk" in {one.path for one in empty_lab.clips}
    page.follow()
    assert empty_lab.clips["raw/slow/walk-slow"].item.tags == ("walk",)


def test_trace_requests(
    empty_lab: ProjectHandle, marey: Marey, reads: Reads, open_receiver: Open, add_walks: AddWalks, tmp_path: Path
) -> None:
    write_named_walks(tmp_path / "takes", "walk")
    add_walks("rigs", "rig")
    collector = open_receiver(status=200)
    page = reads(
        "docs/how-to/trace-requests.md",
        replaced={"http://127.0.0.1:4318": collector.url},
        left_out={"sudo": "installs packages on a server; pins/traces.txt is compared with pyproject.toml elsewhere"},
    )
    assert (ROOT / "pins" / "traces.txt").is_file()
    page.follow(2)
    collector.wait_for(bool)
    assert [one.path for one in empty_lab.clips] == ["rigs/rig", "walk"]
    (studio,) = empty_lab.skeletons
    page.names |= {"lab": empty_lab, "marey": marey, "studio": studio, "files": find_files([tmp_path / "takes"]).files}
    empty_lab.upload(tmp_path / "takes", collection="raw")
    page.follow()
    assert "on-mixamo/raw/walk" in {one.path for one in empty_lab.clips}


def test_the_front_page(
    empty_lab: ProjectHandle, add_walks: AddWalks, name_skeletons: Callable[..., None], reads: Reads, tmp_path: Path
) -> None:
    add_walks("rigs", "rig")
    name_skeletons("mixamo (178 cm)")
    write_walks(tmp_path / "takes", seconds=4.0)
    page = reads(
        "README.md",
        left_out={
            "make ": "installs Marey",
            ". .venv": "changes the shell",
            "marey project create lab": "a fixture has created the project",
        },
        shortened={"marey evaluate": ("--speeds", "1", "--turns", "0", "--duration", 4, "--replicates", 1)},
    )
    page.follow()
    assert len(list(empty_lab.clips.list(collection="walks"))) == 9
    assert len(list((tmp_path / "retargeted").rglob("*.bvh"))) == 9
    assert (tmp_path / "walks.html").read_bytes().startswith(b"<!DOCTYPE html>")
    assert len(list((tmp_path / "samples").glob("*.bvh"))) == 10
