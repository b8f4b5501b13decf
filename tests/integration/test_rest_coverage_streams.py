"""Coverage of performances over HTTP: frames in any media type, what is missing out, each answer once and for all."""

import math

import httpx
import numpy as np
import pytest

from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.access import Role
from marey_schemas.codecs import BSON, JSON, MSGPACK, encode_tree
from rest_server import Server

STREAMS = "/projects/lab/coverage-streams"
RATE_HZ = 60.0


@pytest.fixture(scope="module")
def walk():
    """Five seconds at 1.5 m/s, turning 50 degrees a second to the left."""
    return generate_gait(1.5, math.radians(50.0), 5.0, frame_rate_hz=RATE_HZ)


@pytest.fixture
def skeleton(owner: httpx.Client, walk) -> str:
    mapping = map_joints(walk.skeleton)
    parts = {
        "hierarchy": skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True),
        "mapping": mapping_to_document(mapping, guess_axes(walk.skeleton, mapping)).model_dump(
            mode="json", by_alias=True
        ),
    }
    made = owner.post("/projects/lab/skeletons", json={"name": "body", "parts": parts})
    assert made.status_code == 201, made.text
    return str(made.json()["id"])


def begin(client: httpx.Client, **body) -> dict:
    made = client.post(STREAMS, json={"frame_rate_hz": RATE_HZ, **body})
    assert made.status_code == 201, made.text
    return made.json()


def send(client: httpx.Client, stream: dict, media_type: str = MSGPACK, **frames) -> httpx.Response:
    body = encode_tree(frames, media_type)
    url = f"{STREAMS}/{stream['id']}/frames"
    return client.post(url, content=body, headers={"Content-Type": media_type})


def test_a_performance_fills_its_cell_and_the_next_target_lies_beside_it(owner, skeleton, walk) -> None:
    stream = begin(owner, skeleton=skeleton)
    assert stream["index"] == 0.0
    assert stream["performer"] is None
    offset = 0
    for start in range(0, walk.frame_count, 30):
        answer = send(owner, stream, offset=offset, poses=walk.poses[start : start + 30])
        assert answer.status_code == 200, answer.text
        offset = answer.json()["offset"]
    progress = answer.json()
    assert offset == walk.frame_count
    (cell,) = progress["changed"]
    assert (cell["speed_m_s"], cell["turn_rate_deg_s"], cell["deficit_s"]) == (1.5, 50.0, 0.0)
    performer = progress["performer"]
    assert performer["speed_m_s"] == pytest.approx(1.5, abs=0.1)
    assert performer["turn_rate_deg_s"] == pytest.approx(50.0, abs=5.0)
    nearest = progress["targets"][0]
    assert abs(nearest["speed_m_s"] - 1.5) + abs(nearest["turn_rate_deg_s"] - 50.0) / 100.0 == pytest.approx(0.25)
    assert nearest["path"][0] == [0.0, 0.0, 0.0]
