"""The browser pages: sessions of browsers, the pages in a real Chromium, and the tests of their TypeScript."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.database_fixtures import copied_sqlite
from tests.support.rest_server import Server, running
from tests.support.studying import analysis_of, files_of
from tests.support.tiers import chromium, is_soak
from tests.support.vitest_runs import run_vitest
from tests.support.web_cases import write_cases

from marey_client import Marey
from marey_client.errors import MareyError
from marey_client.poses.player_pages import motions_of_clips, read_template, save_page
from marey_motion import generate_gait, global_positions
from marey_motion.documents import clip_from_document, skeleton_from_document
from marey_motion.formats import write_bvh
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.encoding.codecs import MSGPACK, decode_tree
from marey_server.handlers.browser import pages
from marey_server.store.database.connections import Database

pytestmark = pytest.mark.timeout(900)

HOSTILE_NAME = "</script><img src=x onerror='window.harmed = true'><!--<script>"
LONG_NAME = "path with corners of 90 degrees to the left of the facing direction at 2 m/s, in a take with a long name"
OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}


def exchange(server: Server, code: str, **headers: str) -> httpx.Response:
    """Exchange the code of a link as a new browser does."""
    return httpx.post(f"{server.api}/browser-sessions", json={"code": code}, headers=OWN_PAGE | headers)


def cookie_of(answer: httpx.Response) -> dict[str, str]:
    assert answer.status_code == 201, answer.text
    return {"Cookie": answer.headers["Set-Cookie"].partition(";")[0]}


def test_a_link_signs_one_browser_in_once_to_read_one_project(server: Server, owner: httpx.Client) -> None:
    assert owner.post("/projects", json={"name": "other"}).is_success
    made = owner.post("/projects/lab/browser-links")
    assert made.status_code == 201
    assert made.headers["Cache-Control"] == "no-store"
    code = made.json()["code"]
    assert owner.get("/me", headers={"Authorization": f"Bearer {code}"}).status_code == 401

    answer = exchange(server, code)
    assert exchange(server, code).json()["code"] == "link-invalid"
    attributes = {part.strip() for part in answer.headers["Set-Cookie"].split(";")[1:]}
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= attributes
    session = OWN_PAGE | cookie_of(answer)
    with httpx.Client(base_url=server.api, headers=session) as browser:
        assert browser.get("/projects/lab").status_code == 200
        assert browser.get("/projects/lab/clips").status_code == 200
        assert browser.get("/projects/other").status_code == 404
        assert browser.get("/me").status_code == 401
        assert browser.post("/projects/lab/collections", json={"path": "x"}).status_code == 401
        assert browser.post("/projects/lab/browser-links").status_code == 401
        for site in ("cross-site", "same-site"):  # a page of another site has sent it
            assert browser.get("/projects/lab", headers={"Sec-Fetch-Site": site}).status_code == 404
    token = session["Cookie"].partition("=")[2]
    with httpx.Client(base_url=server.api, headers={"Authorization": f"Bearer {token}"}) as thief:
        assert thief.get("/projects/other").status_code == 404
        assert thief.post("/projects/lab/collections", json={"path": "x"}).status_code == 403


def test_a_browser_ends_its_session_and_no_other(server: Server, owner: httpx.Client) -> None:
    codes = [owner.post("/projects/lab/browser-links").json()["code"] for _ in range(2)]
    plain = cookie_of(exchange(server, codes[0]))
    secure = cookie_of(exchange(server, codes[1], Origin=server.address.replace("http:", "https:")))
    both = OWN_PAGE | {"Cookie": f"{plain['Cookie']}; {secure['Cookie']}"}
    ending = f"{server.api}/browser-sessions/lab"

    def reads(cookie: dict[str, str]) -> bool:
        return httpx.get(f"{server.api}/projects/lab", headers=OWN_PAGE | cookie).is_success

    assert httpx.delete(ending, headers=both | {"Sec-Fetch-Site": "cross-site"}).status_code == 403
    assert httpx.delete(ending, headers=plain | {"Origin": "https://elsewhere.example"}).status_code == 403
    for path in ("browser-sessions/other", "browser-sessions/lab"):  # of another project, and without a cookie
        headers = OWN_PAGE | (plain if path.endswith("other") else {})
        assert httpx.delete(f"{server.api}/{path}", headers=headers).status_code == 204
    assert reads(plain)
    assert reads(secure)

    ended = httpx.delete(ending, headers=OWN_PAGE | plain)
    assert ended.status_code == 204
    (cleared,) = ended.headers.get_list("Set-Cookie")
    assert cleared.startswith('marey-view-lab=""; expires=')
    assert (reads(plain), reads(secure)) == (False, True)
    assert [one["name"] for one in owner.get("/tokens").json()["items"]].count("browser") == 1
    again = httpx.delete(ending, headers=both)
    assert again.status_code == 204
    assert not reads(secure)
    hosted = next(one for one in again.headers.get_list("Set-Cookie") if one.startswith("__Host-"))
    assert "Secure" in hosted, "browsers ignore cookies with this prefix that are not secure, also to delete them"
    assert owner.get("/projects/lab").is_success


def test_a_link_is_refused_to_pages_of_other_sites_and_ends_with_the_token_that_made_it(
    server: Server, owner: httpx.Client
) -> None:
    code = owner.post("/projects/lab/browser-links").json()["code"]
    assert exchange(server, code, **{"Sec-Fetch-Site": "cross-site"}).status_code == 403
    origin = {"Origin": "https://elsewhere.example"}
    assert httpx.post(f"{server.api}/browser-sessions", json={"code": code}, headers=origin).status_code == 403
    guest = httpx.post(f"{server.api}/projects/lab/browser-links")
    assert guest.status_code in (401, 404)

    secure = exchange(server, code, Origin=server.address.replace("http:", "https:"))
    assert secure.headers["Set-Cookie"].startswith("__Host-marey-view-lab=")
    assert "Secure" in secure.headers["Set-Cookie"]
    session = cookie_of(secure)
    assert httpx.get(f"{server.api}/projects/lab", headers=session).status_code == 200
    for ends in ("/logout", "/tokens/{id}"):
        ended = dies_with_its_maker(server, owner, ends)
        assert httpx.get(f"{server.api}/projects/lab", headers=ended).status_code == 401
        assert httpx.get(f"{server.api}/projects/lab", headers=session).status_code == 200, "of another token"
    later = owner.post("/projects/lab/browser-links").json()["code"]
    (own,) = (one for one in owner.get("/tokens").json()["items"] if one["name"] == "test")
    assert owner.delete(f"/tokens/{own['id']}?with_created=true").is_success
    assert httpx.get(f"{server.api}/projects/lab", headers=session).status_code == 401
    assert exchange(server, later).status_code == 404


def dies_with_its_maker(server: Server, owner: httpx.Client, ends: str) -> dict[str, str]:
    """Begin a session with a token of its own, end this token by the route `ends`, and return the cookie."""
    made = owner.post("/tokens", json={"name": "mine", "scopes": ["read", "write"]}).raise_for_status().json()
    maker = server.client(made["secret"])
    session = cookie_of(exchange(server, maker.post("/projects/lab/browser-links").json()["code"]))
    assert httpx.get(f"{server.api}/projects/lab", headers=session).is_success
    if ends == "/logout":
        maker.post(ends).raise_for_status()
    else:
        owner.delete(ends.format(**made)).raise_for_status()
    return session


def test_without_built_pages_a_page_names_the_command_that_builds_them(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "FOLDER", tmp_path / "none")
    missing = httpx.get(f"{server.address}/view?clip=lab/x")
    assert (missing.status_code, missing.headers["Content-Type"]) == (404, "text/html; charset=utf-8")
    assert "make web" in missing.text
    assert '<meta name="viewport" content="width=device-width' in missing.text  # phones do not shrink the page
    assert "color-scheme: light dark" in missing.text
    assert httpx.get(f"{server.address}/assets/a.js").status_code == 404
    token = server.client(server.make_project()).headers["Authorization"].removeprefix("Bearer ")
    with Marey(server.address, token) as marey, pytest.raises(MareyError, match="offers no page that plays motion"):
        read_template(marey.transport)


def test_pages_are_revalidated_their_files_kept_and_their_addresses_relative(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "webui"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text('<base href="./" /><script type="module" src="./assets/a.js"></script>')
    (folder / "assets" / "a.js").write_text("export {};" * 100)
    (folder / "player.html").write_text("<title>Motion</title>")
    (folder / "secret.txt").write_text("not part of the pages")
    monkeypatch.setattr(pages, "FOLDER", folder)
    for path, base in (("/view?clip=lab/x&unknown=1", "./"), ("/studies?study=lab/x", "./"), ("/s/", "../")):
        page = httpx.get(server.address + path)
        assert f'<base href="{base}" />' in page.text
        assert page.headers["Cache-Control"] == "private, no-cache"
        assert page.headers["X-Content-Type-Options"] == "nosniff"
        policy = page.headers["Content-Security-Policy"]
        assert "default-src 'none'; script-src 'self';" in policy
        assert "unsafe" not in policy
        again = httpx.get(server.address + path, headers={"If-None-Match": page.headers["ETag"]})
        assert again.status_code == 304
    player = httpx.get(f"{server.api}/pages/player")
    assert (player.text, player.headers["Content-Type"]) == ("<title>Motion</title>", "text/html; charset=utf-8")
    assert player.headers["Content-Security-Policy"].startswith("sandbox allow-scripts; default-src 'none'")
    script = httpx.get(f"{server.address}/assets/a.js")
    assert (script.text, script.headers["Content-Encoding"]) == ("export {};" * 100, "gzip")
    assert "immutable" in script.headers["Cache-Control"]
    plain = httpx.get(f"{server.address}/assets/a.js", headers={"Accept-Encoding": "identity"})
    assert "Content-Encoding" not in plain.headers
    for path in ("..%2Fsecret.txt", "%2e%2e%2fsecret.txt", "../secret.txt", "index.html"):
        assert httpx.get(f"{server.address}/assets/{path}").status_code == 404


@pytest.fixture
def shown(sqlite_template: Path, tmp_path: Path) -> Iterator[tuple[Server, httpx.Client]]:
    """A server for a browser, and its owner's client; one kind of database is enough for tests of pages."""
    with closing(Database(copied_sqlite(sqlite_template, tmp_path))) as database, running(database, tmp_path) as server:
        yield server, server.client(server.make_project())


@pytest.mark.chromium
def test_the_pages_work_in_a_browser(shown: tuple[Server, httpx.Client], tmp_path: Path) -> None:
    server, owner = shown
    names = [_upload(owner, file) for file in _takes(tmp_path)]
    items = {one["name"]: one["id"] for one in owner.get("/projects/lab/clips").json()["items"]}
    first, second = (f"lab/{items[name]}" for name in names)
    code = owner.post("/projects/lab/browser-links").json()["code"]
    given = {
        "chromium": chromium(),
        "link": f"{server.address}/view?clip={first}&beside={second}#{code}",
        "positions": _positions(owner, items[names[0]]),
        "clips": names,
    }
    run_vitest("browser", "browser/pages.test.ts", MAREY_WEB_GIVEN=json.dumps(given))


@pytest.mark.soak
@pytest.mark.chromium
def test_a_page_from_disk_plays_its_motions_without_a_request(
    shown: tuple[Server, httpx.Client], tmp_path: Path
) -> None:
    server, owner = shown
    names = [_upload(owner, file) for file in _takes(tmp_path)]
    token = owner.headers["Authorization"].removeprefix("Bearer ")
    with Marey(server.address, token) as marey:
        clips = [marey.project("lab").clips[name] for name in names]
        motions = motions_of_clips([(clip, None) for clip in clips], None)
        long = replace(motions[0], name=LONG_NAME)
        hostile = [replace(motions[0], name=HOSTILE_NAME), motions[1]]
        for name, group in (("alone", motions[:1]), ("pair", hostile), ("five", [*motions, *motions, long])):
            save_page(marey.transport, tmp_path / f"{name}.html", group)
        (tmp_path / "empty.html").write_bytes(read_template(marey.transport))
    given = {
        "chromium": chromium(),
        "folder": tmp_path.as_uri(),
        "positions": _positions(owner, clips[0].id),
        "rate": clips[0].frame_rate_hz,
        "names": [names[0], HOSTILE_NAME, names[1]],
    }
    run_vitest("browser", "browser/player.test.ts", MAREY_WEB_GIVEN=json.dumps(given))


@pytest.mark.soak
@pytest.mark.chromium
def test_exactly_the_trials_that_a_participant_answers_in_a_browser_are_recorded(
    shown: tuple[Server, httpx.Client], tmp_path: Path
) -> None:
    server, owner = shown
    trials = 10 if is_soak() else 4
    takes = [_upload(owner, file) for file in _takes(tmp_path)]
    for number in range(7):
        file = tmp_path / f"gait {number}.bvh"
        file.write_bytes(write_bvh(generate_gait(speed_m_s=0.6 + 0.2 * number, turn_rate_rad_s=0.0, duration_s=2.0)))
        _upload(owner, file)
    token = owner.headers["Authorization"].removeprefix("Bearer ")
    with Marey(server.address, token) as marey:
        studies, clips = marey.project("lab").studies, list(marey.project("lab").clips.list())
        gaits = [clip for clip in clips if clip.item.name not in takes]
        calm = studies.design(
            "Walks", gaits, consent_text="I take part.\nI may stop at any time.", trials=trials, seconds=120
        )
        hurried = studies.design("Hurried", clips, consent_text="I take part.", trials=1, seconds=1)
        codes = [link.code for study, count in ((calm, 3), (hurried, 1)) for link in study.invite(count).links]
        rita = server.make_user("rita")
        assert owner.put("/projects/lab/members/rita", json={"role": "reader"}).is_success
        given = {
            "chromium": chromium(),
            "page": f"{server.address}/s/",
            "codes": dict(zip(("whole", "withdrawn", "slow", "hurried"), codes, strict=True)),
            "trials": trials,
            "conductor": _study_page(server, owner, calm.id),
            "reader": _study_page(server, server.client(rita), calm.id),
            "api": server.api,
            "token": token,
            "study": f"projects/lab/studies/{calm.id}",
            "item": calm.id,
            "worker": server.make_user("wanda", administrator=True, scopes=("work",)),
            "files": _written(files_of(analysis_of(7), {"item": calm.id, "revision": 1}), tmp_path),
            "answers": str(tmp_path / "answers.json"),
        }
        run_vitest("browser", "browser/study.test.ts", MAREY_WEB_GIVEN=json.dumps(given))

        answers = json.loads((tmp_path / "answers.json").read_text())
        judged = {one.participant: one for one in calm.judgements()}
        recorded = judged["p1"].trials
        assert [(one.number, list(one.shown), list(one.chosen or ())) for one in recorded] == [
            (one["number"], one["shown"], one["chosen"]) for one in answers
        ]
        assert [one.number for one in recorded] == list(range(1, trials + 1))
        assert {(one.client_fps, one.timeouts_before) for one in recorded} == {(60.0, 0)}
        progress = calm.progress()
        assert (progress.finished, progress.withdrawn, progress.answered, progress.timeouts) == (1, 1, trials, 0)
        assert "p2" not in judged
        assert (hurried.progress().answered, hurried.progress().timeouts) == (0, 1)


def _written(files: dict[str, bytes], folder: Path) -> dict[str, str]:
    """Write files, and return their paths by name."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return {name: str(folder / name) for name in files}


def _study_page(server: Server, reader: httpx.Client, study: str) -> str:
    """Return the address of the page of a study, with the code of a new link."""
    code = reader.post("/projects/lab/browser-links").json()["code"]
    return f"{server.address}/studies?study=lab/{study}#{code}"


def _takes(folder: Path) -> list[Path]:
    """Return a real take, if there is real motion capture, and a generated one."""
    walk = folder / "walk.bvh"
    walk.write_bytes(write_bvh(generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.3, duration_s=3.0)))
    real = Path(os.environ.get("MAREY_TEST_MOCAP", "")) / "cmu-bvh" / "10_01.bvh"
    turn = folder / "turn.bvh"
    turn.write_bytes(write_bvh(generate_gait(speed_m_s=0.8, turn_rate_rad_s=-0.9, duration_s=2.0)))
    return [real if real.is_file() else turn, walk]


def _upload(owner: httpx.Client, file: Path) -> str:
    answer = owner.post("/projects/lab/imports", files={"files": (file.name, file.read_bytes())})
    assert answer.json()["entries"][0]["status"] == "created", answer.text
    return file.stem


def _positions(owner: httpx.Client, clip: str) -> dict[str, list[float]]:
    """Return positions of all joints by forward kinematics of the server, at some frames of a stored clip."""

    def read(path: str) -> Any:
        return decode_tree(owner.get(path, headers={"Accept": MSGPACK}).content, MSGPACK)

    tree = read(f"/projects/lab/clips/{clip}/parts/motion")
    motion = MotionDocument.model_validate(tree)
    skeleton = owner.get(f"/projects/lab/skeletons/{tree['skeleton']['item']}/parts/hierarchy").json()
    take = clip_from_document(motion, skeleton_from_document(SkeletonHierarchy.model_validate(skeleton)))
    positions = global_positions(take).astype(np.float64)
    return {str(frame): positions[frame].ravel().tolist() for frame in (0, 17, take.frame_count - 1)}


@pytest.mark.node
def test_decoder_and_kinematics_in_typescript_agree_with_those_in_python(tmp_path: Path) -> None:
    write_cases(tmp_path)
    run_vitest("unit", MAREY_WEB_CASES=str(tmp_path))
