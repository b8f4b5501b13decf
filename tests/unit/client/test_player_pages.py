"""Pages that play motion without a server: packed poses, escaped names, atomic writes of files, and refusals."""

import json
import re
import zlib
from base64 import b64decode
from pathlib import Path
from typing import Any

import hatch_build
import httpx
import numpy as np
import pytest
from tests.support.scripted_server import ScriptedServer, problem

from marey_client.cli.viewing import PAGE_ENDING
from marey_client.errors import BadArgument, MareyError
from marey_client.poses.packing import LENGTH_STEP_M, pack_motion, rotation_vectors
from marey_client.poses.player_pages import ShownMotion, page_with, save_page
from marey_schemas.documents.clips import MotionDocument

TEMPLATE = b'<title>x</title><script type="application/json" id="motion"></script>'
JOINTS = 63
MOST_BYTES = 1_500_000
MOST_ERROR_DEG = 0.01


def a_motion(*, duration_s: float = 1.0, rate_hz: float = 30.0, seed: int = 7) -> MotionDocument:
    """Return a motion of 63 joints, each of which swings about an axis of its own, with noise as of a capture."""
    random = np.random.default_rng(seed)
    frames = round(duration_s * rate_hz)
    time_s = np.arange(frames)[:, None, None] / rate_hz
    axes = random.normal(size=(1, JOINTS, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = random.uniform(0.3, 1.5, (1, JOINTS, 1)) * np.sin(
        2 * np.pi * random.uniform(0.2, 2, (1, JOINTS, 1)) * time_s
    )
    vectors = axes * turns + random.normal(scale=2e-4, size=(frames, JOINTS, 3))
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    quaternions = np.concatenate((np.cos(half), np.sin(half) / (2 * half) * vectors), axis=-1)
    root = np.concatenate((1.2 * time_s[:, 0], np.ones((frames, 1)), 0.1 * time_s[:, 0]), axis=1)
    poses = np.concatenate((root, quaternions.reshape(frames, -1)), axis=1).astype(np.float32)
    names = tuple(f"joint {number}" for number in range(JOINTS))
    skeleton: Any = {"item": "skeleton_x", "revision": 1}
    return MotionDocument(skeleton=skeleton, frame_rate_hz=rate_hz, joints=names, poses=poses)


def a_shown(name: str = "walk", **options: Any) -> ShownMotion:
    joints = [{"name": f"joint {n}", "parent": n - 1, "offset": [0, 0.1, 0]} for n in range(JOINTS)]
    return ShownMotion(name, a_motion(**options), {"joints": joints})


def data_of(page: bytes) -> str:
    found = re.search(r'<script type="application/json" id="motion">(.*?)</script>', page.decode(), re.DOTALL)
    assert found is not None
    return found[1]


def test_rounding_turns_no_joint_by_more_than_the_documented_angle() -> None:
    random = np.random.default_rng(3)
    turned = random.normal(size=(4000, 1, 4))
    turned[:4, 0] = ((1, 0, 0, 0), (-1, 0, 0, 0), (0, 1, 0, 0), (1e-9, 0, -1, 0))
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    step = pack_motion(a_motion())["angle_step_rad"]
    vectors = np.rint(rotation_vectors(turned.astype(np.float32)) / step) * step
    assert np.abs(vectors / step).max() < 2**15
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    sine = np.divide(np.sin(half), 2 * half, out=np.full_like(half, 0.5), where=half > 0)
    again = np.concatenate((np.cos(half), sine * vectors), axis=-1)
    short = np.minimum(np.linalg.norm(again - turned, axis=-1), np.linalg.norm(again + turned, axis=-1))
    assert np.degrees(4 * np.arcsin(short / 2)).max() < MOST_ERROR_DEG
    assert LENGTH_STEP_M / 2 == 25e-6


def test_a_root_far_from_the_origin_is_packed_with_a_greater_step() -> None:
    motion = a_motion()
    far = motion.poses.copy()
    far[:, 2] += 5.4e6  # metres to the equator, as in geographical coordinates
    packed = pack_motion(motion.model_copy(update={"poses": far}))
    planes = np.frombuffer(zlib.decompress(b64decode(packed["lengths"])), np.uint8).reshape(4, -1).T
    folded = np.ascontiguousarray(planes).view("<u4").reshape(3, -1).astype(np.int64)
    again = np.cumsum((folded >> 1) ^ -(folded & 1), axis=1) * packed["length_step_m"]
    np.testing.assert_allclose(again.T, far[:, :3], atol=packed["length_step_m"])


@pytest.mark.parametrize("rate_hz", [30.0, 120.0])
def test_a_page_of_30_s_and_63_joints_is_smaller_than_the_limit(rate_hz: float) -> None:
    built = hatch_build.PAGES / "player.html"
    viewer = built.stat().st_size if built.is_file() else 700_000  # the limit in web/sizes.mjs
    page = page_with(TEMPLATE, "walk", [a_shown(duration_s=30.0, rate_hz=rate_hz)])
    assert len(page) + viewer < MOST_BYTES


def test_a_name_cannot_end_the_element_with_the_data() -> None:
    name = "</script><img src=x onerror=alert(1)><!--<script>"
    page = page_with(TEMPLATE, name, [a_shown(name)])
    assert page.count(b"</script>") == 1
    assert b"<img" not in page
    content = json.loads(data_of(page))
    assert [content["title"], content["motions"][0]["name"]] == [name, name]
    assert content["motions"][0]["frames"] == 30


def test_a_page_is_written_whole_or_not_at_all(script: ScriptedServer, tmp_path: Path) -> None:
    target = tmp_path / f"walk{PAGE_ENDING}"
    script.answers += [httpx.Response(200, content=TEMPLATE), httpx.Response(200, content=b"<title>other</title>")]
    with script.marey() as marey:
        save_page(marey.transport, target, [a_shown("a"), a_shown("b")])
        written = target.read_bytes()
        assert json.loads(data_of(written))["title"] == "a beside b"
        with pytest.raises(MareyError, match="no element for motion, because client and server"):
            save_page(marey.transport, target, [a_shown("c")])
    assert target.read_bytes() == written
    assert list(tmp_path.iterdir()) == [target]
    assert {request.url.path for request in script.requests} == {"/api/v1/pages/player"}


@pytest.mark.parametrize(
    ("names", "title"),
    [(["sample 1"], "samples of walk: sample 1"), (["sample 1", "sample 2"], "samples of walk")],
)
def test_the_title_of_a_page_says_what_the_motions_are(
    script: ScriptedServer, tmp_path: Path, names: list[str], title: str
) -> None:
    script.answers.append(httpx.Response(200, content=TEMPLATE))
    with script.marey() as marey:
        save_page(marey.transport, tmp_path / "samples.html", [a_shown(name) for name in names], "samples of walk")
    assert json.loads(data_of((tmp_path / "samples.html").read_bytes()))["title"] == title


def test_a_server_without_pages_is_named_with_what_to_do(script: ScriptedServer, tmp_path: Path) -> None:
    script.answers.append(problem(404, "not-found"))
    with script.marey() as marey, pytest.raises(MareyError, match=r"server\.test offers no page .* Run `make web`"):
        save_page(marey.transport, tmp_path / "walk.html", [a_shown()])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [0, 13])
def test_a_page_with_no_or_too_many_motions_is_refused(script: ScriptedServer, tmp_path: Path, count: int) -> None:
    with script.marey() as marey, pytest.raises(BadArgument, match=f"plays 1 to 12 motions, not {count}"):
        save_page(marey.transport, tmp_path / "walk.html", [a_shown()] * count)
