"""Shell completion with a server: paths step by step, jobs, versions, and nothing that the token may not know."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.rest_server import Server

from marey_client.cli.completion.asking import MOST_ENTRIES
from marey_schemas.access import Role

LAB = "/projects/lab"
ODD = ("walk", "walk fast", "wälk", "walk: 2", "walk@2", "wa'lk", "walk*x", "50%_walk", "walk&run?x=1#y")


def ok(response: httpx.Response) -> Any:
    assert response.is_success, response.text
    return response.json() if response.content else None


def skeleton(name: str, folder: str) -> dict[str, Any]:
    joints = [{"name": "Hips", "parent": -1, "offset": [0, 1, 0]}]
    return {
        "name": name,
        "collection": folder,
        "parts": {"hierarchy": {"schema": "marey/skeleton@1", "joints": joints}},
    }


class Shell:
    """A user at a shell."""

    def __init__(self, server: Server, token: str | None, folder: Path) -> None:
        self.environment = {"MAREY_SERVER": server.address, "XDG_CONFIG_HOME": str(folder), "MAREY_DATA": str(folder)}
        if token is not None:
            self.environment["MAREY_TOKEN"] = token

    def __call__(self, line: str) -> list[str]:
        """Return the suggestions for the end of a line, without remarks."""
        asked = {"_MAREY_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": line, **self.environment}
        with mock.patch.dict(os.environ, asked), mock.patch("marey_client.cli.completion.asking.PATIENCE_S", 60):
            done = run_here([])
        assert (done.returncode, done.stderr) == (0, "")
        return [one.partition("\t")[0] for one in done.stdout.splitlines()]


@pytest.fixture
def token(server: Server) -> str:
    """Token of the owner of the project `lab`, in which there are folders, skeletons and a dataset."""
    server.make_user("rita")
    token = server.make_project("lab", rita=Role.READER)
    owner = server.client(token)
    for name in ODD:
        ok(owner.post(f"{LAB}/skeletons", json=skeleton(name, "raw")))
    ok(owner.post(f"{LAB}/skeletons", json=skeleton("deep", "raw/day 1/rig")))
    ok(owner.post(f"{LAB}/collections", json={"path": "results"}))
    ok(owner.post(f"{LAB}/datasets", json={"name": "gaits", "collection": "raw"}))
    ok(owner.post(f"{LAB}/datasets/gaits/commits", json={"message": "m"}))
    ok(owner.post(f"{LAB}/datasets/gaits/refs", json={"name": "v1", "kind": "tag", "at": "main"}))
    ok(owner.post(f"{LAB}/datasets/gaits/refs", json={"name": "trial", "kind": "branch", "at": "main"}))
    return token


@pytest.fixture
def shell(server: Server, token: str, tmp_path: Path) -> Shell:
    """The owner of the project `lab` at a shell."""
    return Shell(server, token, tmp_path)


def test_addresses_are_completed_step_by_step(shell: Shell) -> None:
    assert shell("marey show ") == ["lab/"]
    assert shell("marey project show l") == ["lab"]
    assert shell("marey show lab/") == ["lab/raw/", "lab/results/"]
    assert shell("marey show lab/ra") == ["lab/raw/"]
    assert shell("marey show lab/raw/d") == ["lab/raw/day 1/"]
    assert shell(r"marey show lab/raw/day\ 1/") == ["lab/raw/day 1/rig/"]
    assert shell("marey show 'lab/raw/day 1/rig/") == ["lab/raw/day 1/rig/deep"]
    assert shell("marey show nothing/") == []
    assert shell("marey show lab/raw/nothing/") == []


def test_odd_names_are_completed(shell: Shell) -> None:
    assert set(shell("marey show lab/raw/")) == {"lab/raw/day 1/", *(f"lab/raw/{name}" for name in ODD)}
    for name in ODD:
        quoted = name.replace("'", "'\\''")
        assert f"lab/raw/{name}" in shell(f"marey show 'lab/raw/{quoted}"), name
    assert shell("marey show 'lab/raw/walk*") == ["lab/raw/walk*x"]
    assert shell("marey show lab/raw/wä") == ["lab/raw/wälk"]
    assert shell("marey show lab/raw/50%_") == ["lab/raw/50%_walk"]


def test_only_items_of_the_kind_that_a_parameter_takes_are_shown(shell: Shell) -> None:
    assert "lab/raw/walk" in shell("marey skeleton map lab/raw/walk")
    assert "lab/raw/walk" in shell("marey retarget lab/raw --to lab/raw/")
    assert shell("marey view lab/raw/") == ["lab/raw/day 1/"]
    assert shell("marey ls lab/r") == ["lab/raw/", "lab/results/"]
    assert shell("marey retarget lab/raw --into r") == ["raw/", "results/"]
    assert shell("marey evaluate lab/raw --into=res") == ["--into=results/"]


def test_versions_and_branches_are_completed(shell: Shell) -> None:
    assert shell("marey dataset log lab/g") == ["lab/gaits"]
    assert shell("marey dataset diff lab/gaits@") == ["lab/gaits@main", "lab/gaits@trial", "lab/gaits@v1"]
    assert shell("marey dataset diff lab/gaits@v1 t") == ["trial"]
    assert shell("marey dataset diff lab/gaits@v1 --path d") == ["day 1/"]
    assert shell("marey dataset diff lab/gaits@v1 --path 'day 1/rig/") == ["day 1/rig/deep"]
    assert shell("marey dataset diff lab/gaits --path walk\\ ") == ["walk fast"]
    assert shell("marey evaluate lab/gaits@v") == ["lab/gaits@v1"]
    assert shell("marey dataset merge lab/gaits@trial --into ") == ["main", "trial"]
    assert shell("marey evaluate lab/raw --commit-to gaits@") == ["gaits@main", "gaits@trial"]


@pytest.mark.usefixtures("test_kinds")
def test_jobs_are_completed_in_the_states_that_a_command_takes(shell: Shell, server: Server, token: str) -> None:
    job = ok(server.client(token).post(f"{LAB}/jobs", json={"kind": "errand"}))["id"]
    assert shell("marey job show ") == [job]
    assert shell(f"marey job log {job[:7]}") == [job]
    assert shell("marey job cancel ") == [job]
    assert shell("marey job retry ") == []


def test_many_names_are_bounded(shell: Shell, server: Server, token: str) -> None:
    owner = server.client(token)
    for number in range(MOST_ENTRIES + 5):
        ok(owner.post(f"{LAB}/collections", json={"path": f"many/{number:03}/below"}))
    assert len(shell("marey ls lab/many/")) == MOST_ENTRIES
    assert shell(f"marey ls lab/many/{MOST_ENTRIES + 1}") == [f"lab/many/{MOST_ENTRIES + 1}/"]
    assert shell("marey ls lab/re") == ["lab/results/"]


def test_lists_that_have_no_filter_are_read_to_their_end(shell: Shell, server: Server, token: str) -> None:
    for number in range(3):
        ok(server.client(token).post(f"{LAB}/datasets", json={"name": f"g{number}", "collection": "raw"}))
    with mock.patch("marey_client.cli.completion.asking.MOST_ENTRIES", 2):
        assert shell("marey dataset log lab/g2") == ["lab/g2"]
        assert shell("marey dataset log lab/") == ["lab/g0", "lab/g1", "lab/g2", "lab/gaits"]
        assert shell("marey dataset diff lab/gaits@v") == ["lab/gaits@v1"]


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(
    "line",
    [
        "marey show ", "marey show lab/", "marey show lab/raw/", "marey ls lab/r", "marey dataset log lab/",
        "marey dataset diff lab/gaits@", "marey job show ", "marey script run lab ", "marey member remove lab ",
        "marey webhook show lab ", "marey user show ", "marey evaluate lab --into ",
    ],
)  # fmt: skip
def test_nothing_is_shown_that_the_token_may_not_know(
    line: str, shell: Shell, server: Server, token: str, tmp_path: Path
) -> None:
    assert Shell(server, None, tmp_path)(line) == []
    assert Shell(server, "marey_wrong_token", tmp_path)(line) == []
    narrow = ok(server.client(token).post("/tokens", json={"name": "t", "scopes": ["write"]}))["secret"]
    assert Shell(server, narrow, tmp_path)(line) == []


def test_members_see_what_their_role_lets_them_see(server: Server, token: str, tmp_path: Path) -> None:
    ok(server.client(token).patch(LAB, json={"visibility": "public"}, headers={"If-Match": "*"}))
    anybody = Shell(server, None, tmp_path)
    assert anybody("marey show lab/r") == ["lab/raw/", "lab/results/"]
    assert anybody("marey member remove lab ") == []
    assert anybody("marey script run lab ") == []


def test_folders_are_selected_by_name_only_within_a_folder(server: Server, token: str) -> None:
    owner = server.client(token)

    def listed(**query: str) -> list[str]:
        return [one["path"] for one in ok(owner.get(f"{LAB}/collections", params=query))["items"]]

    assert listed(directly_in="raw", name="day 1") == ["raw/day 1"]
    assert listed(directly_in="raw", name="day") == []
    assert listed(directly_in="raw/day 1") == ["raw/day 1/rig"]
    assert listed(directly_in="", name="r%*") == []
    refused = owner.get(f"{LAB}/collections", params={"name": "raw"})
    assert (refused.status_code, refused.json()["code"]) == (400, "bad-filter")
