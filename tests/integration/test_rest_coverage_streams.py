"""Coverage of recordings over HTTP: frames in every media type, missing motions, and repeated requests."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.rest_server import Server, running

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.access import Role
from marey_schemas.documents.skeletons import SkeletonMapping
from marey_schemas.encoding.codecs import BSON, JSON, MSGPACK, encode_tree

STREAMS = "/projects/lab/coverage-streams"
RATE_HZ = 60.0


@pytest.fixture(scope="module")
def walk() -> Clip:
    """A walk of five seconds at 1.5 m/s that turns to the left by 50 degrees per second."""
    return generate_gait(1.5, math.radians(50.0), 5.0, frame_rate_hz=RATE_HZ)


@pytest.fixture
def skeleton(owner: httpx.Client, walk: Clip) -> str:
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


def begin(client: httpx.Client, **body: Any) -> dict[str, Any]:
    made = client.post(STREAMS, json={"frame_rate_hz": RATE_HZ, **body})
    assert made.status_code == 201, made.text
    return made.json()


def send(client: httpx.Client, stream: dict[str, Any], media_type: str = MSGPACK, **frames: Any) -> httpx.Response:
    body = encode_tree(frames, media_type)
    url = f"{STREAMS}/{stream['id']}/frames"
    return client.post(url, content=body, headers={"Content-Type": media_type})


def test_a_performance_fills_its_cell_and_the_next_target_lies_beside_it(
    owner: httpx.Client, skeleton: str, walk: Clip
) -> None:
    stream = begin(owner, skeleton=skeleton)
    assert stream["index"] == 0.0
    assert stream["performer"] is None
    offset = 0
    progress: dict[str, Any] = {}
    for start in range(0, walk.frame_count, 30):
        answer = send(owner, stream, offset=offset, poses=walk.poses[start : start + 30])
        assert answer.status_code == 200, answer.text
        progress = answer.json()
        offset = progress["offset"]
    assert offset == walk.frame_count
    (cell,) = progress["changed"]
    assert (cell["speed_m_s"], cell["turn_rate_deg_s"], cell["deficit_s"]) == (1.5, 50.0, 0.0)
    performer = progress["performer"]
    assert performer["speed_m_s"] == pytest.approx(1.5, abs=0.1)
    assert performer["turn_rate_deg_s"] == pytest.approx(50.0, abs=5.0)
    nearest = progress["targets"][0]
    assert abs(nearest["speed_m_s"] - 1.5) + abs(nearest["turn_rate_deg_s"] - 50.0) / 100.0 == pytest.approx(0.25)
    assert nearest["path"][0] == [0.0, 0.0, 0.0]


def circling(speed_m_s: float, turn_rate_deg_s: float, seconds: float) -> Floats:
    """Return roots (n, 3) of a body that moves in the direction that it faces."""
    headings = math.radians(turn_rate_deg_s) * np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ
    steps = speed_m_s / RATE_HZ * np.stack((np.sin(headings), np.cos(headings)), axis=-1)
    return np.asarray(np.column_stack((np.cumsum(steps, axis=0) - steps, headings)), dtype=np.float64)


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    return answer.json()


def test_frames_come_in_every_media_type(owner: httpx.Client) -> None:
    roots = circling(2.0, -50.0, 3.0)
    for media_type in (JSON, MSGPACK, BSON):
        progress = send(owner, begin(owner), media_type, offset=0, roots=roots, ends_take=True).json()
        assert (progress["offset"], progress["windows"]) == (181, 121), media_type
        assert len(progress["changed"]) == 1, media_type
        (cell,) = progress["changed"]
        assert (cell["speed_m_s"], cell["turn_rate_deg_s"]) == (2.0, -50.0), media_type
        assert cell["seconds"] == pytest.approx(121 / 60), media_type
        assert progress["performer"] is None, media_type


def test_the_map_is_there_for_who_looks_on(owner: httpx.Client, server: Server) -> None:
    stream = begin(owner, speeds_m_s=[2.0, 1.0], turn_rates_deg_s=[-50.0, 0.0, 50.0], least_s=2.0, target_count=1)
    assert (stream["speeds_m_s"], stream["delay_s"], stream["missing_s"]) == ([1.0, 2.0], 0.5, 12.0)
    send(owner, stream, offset=0, roots=circling(2.0, -50.0, 3.0), ends_take=True)
    shown = owner.get(f"{STREAMS}/{stream['id']}")
    state = shown.json()
    assert state["offset"] == 181
    assert state["seconds"][1][0] == pytest.approx(121 / 60)
    assert state["deficit_s"] == [[2.0, 2.0, 2.0], [0.0, 2.0, 2.0]]
    assert state["index"] == pytest.approx(1 / 6)
    assert len(state["targets"]) == 1
    unchanged = owner.get(f"{STREAMS}/{stream['id']}", headers={"If-None-Match": shown.headers["ETag"]})
    assert unchanged.status_code == 304
    (listed,) = owner.get(STREAMS).json()["items"]
    assert (listed["id"], listed["offset"]) == (stream["id"], 181)


def test_the_same_frames_again_get_the_same_answer_and_count_once(owner: httpx.Client) -> None:
    stream = begin(owner)
    roots = circling(2.0, 50.0, 3.0)
    first = send(owner, stream, offset=0, roots=roots[:100])
    again = send(owner, stream, JSON, offset=0, roots=roots[:100])  # in other words
    assert again.json() == first.json()
    onward = send(owner, stream, offset=100, roots=roots[100:])
    assert onward.json()["offset"] == 181
    late = problem(send(owner, stream, offset=0, roots=roots[:100]), 409)
    assert (late["code"], late["context"]) == ("coverage-offset", {"offset": 181})


def test_frames_that_leave_a_gap_are_told_where_to_go_on(owner: httpx.Client) -> None:
    stream = begin(owner)
    roots = circling(2.0, 50.0, 1.0)
    send(owner, stream, offset=0, roots=roots[:10])
    for offset in (0, 9, 11, 1000):
        refused = problem(send(owner, stream, offset=offset, roots=roots[10:20]), 409)
        assert refused["context"] == {"offset": 10}
    assert send(owner, stream, offset=10, roots=roots[10:20]).json()["offset"] == 20


def test_a_pause_begins_a_new_take(owner: httpx.Client) -> None:
    stream = begin(owner)
    roots = circling(2.0, 0.0, 1.5)
    send(owner, stream, offset=0, roots=roots)
    ended = send(owner, stream, offset=91, ends_take=True).json()
    assert (ended["offset"], ended["windows"], ended["performer"]) == (91, 30, None)
    assert send(owner, stream, offset=91, ends_take=True).json() == ended
    later = send(owner, stream, offset=91, roots=roots + np.array([100.0, 0.0, 0.0]), ends_take=True).json()
    assert (later["offset"], later["windows"]) == (182, 31)
    assert len(later["changed"]) == 1


def test_any_server_goes_on_where_another_one_left_off(
    owner: httpx.Client, server: Server, open_database: Callable[..., Any], tmp_path: Path, walk: Clip, skeleton: str
) -> None:
    straight, moved = begin(owner, skeleton=skeleton), begin(owner, skeleton=skeleton)
    token = owner.headers["Authorization"].removeprefix("Bearer ")
    with running(open_database(), tmp_path / "other") as other:
        for offset in range(0, walk.frame_count, 25):
            poses = walk.poses[offset : offset + 25]
            expected = send(owner, straight, offset=offset, poses=poses).json()
            either = (owner, other.client(token))[offset // 25 % 2]
            assert send(either, moved, offset=offset, poses=poses).json() == expected


def test_it_goes_on_from_what_an_evaluation_found(owner: httpx.Client) -> None:
    measured = {
        "options": {"grid": {"speeds_m_s": [1.0, 2.0], "turn_rates_deg_s": [0.0]}, "coverage_least_s": 3.0},
        "coverage": {"seconds": {"dtype": "<f8", "shape": [2, 1], "data": [[5.0], [1.5]]}},
    }
    document = {"schema": "marey/evaluation@1", "verdict": "Good.", "headline": {}, **measured}
    made = owner.post("/projects/lab/evaluations", json={"name": "walks-eval", "parts": {"evaluation": document}})
    stream = begin(owner, evaluation=made.json()["id"])
    assert stream["evaluation"] == {"item": made.json()["id"], "revision": 1}
    assert (stream["least_s"], stream["index"], stream["missing_s"]) == (3.0, 0.5, 1.5)
    progress = send(owner, stream, offset=0, roots=circling(2.0, 0.0, 2.5), ends_take=True).json()
    assert progress["changed"][0]["seconds"] == pytest.approx(1.5 + 91 / 60)
    assert (progress["index"], progress["targets"]) == (1.0, [])
    both = owner.post(STREAMS, json={"frame_rate_hz": 60, "evaluation": made.json()["id"], "least_s": 1})
    assert "give either the evaluation or" in problem(both, 422)["detail"]


@pytest.mark.parametrize(
    ("seconds", "least_s", "said"),
    [
        ([[5.0]], 1.0, "1 cells"),
        ([[5.0], [-1.0]], 1.0, "coverage: seconds: the value of each cell"),
        ([[5.0], [1e300]], 1.0, "coverage: seconds: the value of each cell"),
        ([[5.0], [1.0]], 0.0, "options.coverage_least_s"),
        (None, 1.0, "coverage: this field is missing"),
    ],
)
def test_an_evaluation_without_a_map_that_makes_sense_is_refused(
    owner: httpx.Client, seconds: list[list[float]] | None, least_s: float, said: str
) -> None:
    grid = {"speeds_m_s": [1.0, 2.0], "turn_rates_deg_s": [0.0]}
    document = {
        "schema": "marey/evaluation@1", "verdict": "", "headline": {},
        "options": {"grid": grid, "coverage_least_s": least_s},
    }  # fmt: skip
    if seconds is not None:
        document["coverage"] = {"seconds": {"dtype": "<f8", "shape": [len(seconds), 1], "data": seconds}}
    made = owner.post("/projects/lab/evaluations", json={"name": "odd", "parts": {"evaluation": document}})
    refused = problem(owner.post(STREAMS, json={"frame_rate_hz": 60, "evaluation": made.json()["id"]}), 422)
    assert refused["errors"][0]["pointer"] == "/evaluation"
    assert said in refused["detail"].replace("(1, 1)", "1 cells")


def test_a_skeleton_that_tells_no_direction_is_refused(owner: httpx.Client) -> None:
    chain = {"schema": "marey/skeleton@1", "joints": [{"name": "j", "parent": -1, "offset": [0, 1, 0]}]}
    mapping = SkeletonMapping(method="manual", confidence=1.0, joints={"root": "j"})
    parts = {"hierarchy": chain, "mapping": mapping.model_dump(mode="json", by_alias=True)}
    made = owner.post("/projects/lab/skeletons", json={"name": "chain", "parts": parts})
    refused = problem(owner.post(STREAMS, json={"frame_rate_hz": 60, "skeleton": made.json()["id"]}), 422)
    assert refused["errors"][0]["pointer"] == "/skeleton"
    assert "ankle" in refused["detail"]


SENSELESS: list[Any] = [
    ({"frame_rate_hz": 5}, "must be at least 10"),
    ({"frame_rate_hz": 1000}, "at most 240"),
    ({"frame_rate_hz": 60, "speeds_m_s": [1, 1]}, "contains a value twice"),
    ({"frame_rate_hz": 60, "speeds_m_s": list(range(1, 21)), "turn_rates_deg_s": list(range(150))}, "3000 cells"),
    ({"frame_rate_hz": 60, "target_count": 17}, "at most 16"),
    ({}, "this field is missing"),
]


def test_a_skeleton_that_is_hardly_recognised_is_refused(owner: httpx.Client, walk: Clip) -> None:
    mapping = mapping_to_document(map_joints(walk.skeleton), {}).model_copy(update={"confidence": 0.1})
    parts = {
        "hierarchy": skeleton_to_document(walk.skeleton).model_dump(mode="json", by_alias=True),
        "mapping": mapping.model_dump(mode="json", by_alias=True),
    }
    made = owner.post("/projects/lab/skeletons", json={"name": "doubtful", "parts": parts})
    assert made.status_code == 201, made.text
    body = {"frame_rate_hz": RATE_HZ, "skeleton": made.json()["id"]}
    refused = problem(owner.post(STREAMS, json=body), 422)
    assert (refused["code"], refused["errors"][0]["pointer"]) == ("mapping-uncertain", "/skeleton")
    assert "marey skeleton map --confirm" in refused["detail"]


def test_streams_that_make_no_sense_are_refused(owner: httpx.Client) -> None:
    for body, said in SENSELESS:
        answer = owner.post(STREAMS, json=body)
        assert (answer.status_code, said in answer.text) == (422, True), (body, answer.text)


def test_a_grid_of_which_one_side_is_given_has_its_limit_too(owner: httpx.Client) -> None:
    refused = owner.post(STREAMS, json={"frame_rate_hz": 60, "turn_rates_deg_s": [step / 4 for step in range(200)]})
    assert refused.status_code == 201
    speeds = [0.05 * step for step in range(1, 201)]
    turn_rates = [float(step) for step in range(11)]
    too_many = owner.post(STREAMS, json={"frame_rate_hz": 60, "speeds_m_s": speeds, "turn_rates_deg_s": turn_rates})
    assert "2200 cells" in problem(too_many, 422)["detail"]


def test_frames_that_make_no_sense_are_refused_and_change_nothing(
    owner: httpx.Client, skeleton: str, walk: Clip
) -> None:
    stream, rootless = begin(owner, skeleton=skeleton), begin(owner)
    poses = np.array(walk.poses[:10])
    long = poses.copy()
    long[3, 7:11] *= 2.0
    far = np.zeros((2, 3))
    far[1, 0] = 1e9
    wrong: list[tuple[dict[str, Any], dict[str, Any], str]] = [
        (stream, {"poses": long}, "the rotation in frame 3 must be a unit quaternion"),
        (stream, {"poses": poses[:, :-4]}, "columns"),
        (stream, {"poses": poses.astype(np.float64) * 1e300}, "only finite numbers"),
        (stream, {"poses": poses.astype(np.int32)}, "<f4 or <f8"),
        (stream, {"poses": np.zeros((5000, poses.shape[1]), np.float32)}, "at most 4096"),
        (stream, {"poses": poses, "roots": np.zeros((10, 3))}, "not both"),
        (stream, {"poses": poses, "translated_joints": ["Hips"]}, "translations and translated_joints: give both"),
        (stream, {"roots": far}, "from the origin"),
        (stream, {"poses": poses * np.float32(1e30)}, "has length"),
        (stream, {"poses": np.hstack((poses[:, :3] + 1e30, poses[:, 3:]))}, "from the origin"),
        (stream, {"roots": np.zeros((2, 4))}, "3 columns"),
        (stream, {"roots": np.zeros((0, 3))}, "send frames, or set ends_take"),
        (stream, {}, "send frames, or set ends_take"),
        (rootless, {"poses": poses}, "without one"),
    ]  # fmt: skip
    for to, frames, said in wrong:
        assert said in problem(send(owner, to, offset=0, **frames), 422)["detail"], frames
    for one in (stream, rootless):
        assert owner.get(f"{STREAMS}/{one['id']}").json()["rev"] == 1


def test_joints_that_move_in_their_parents_count(owner: httpx.Client, skeleton: str, walk: Clip) -> None:
    child = walk.skeleton.joint_names[1]
    shifted = np.broadcast_to(walk.skeleton.offsets[1], (walk.frame_count, 1, 3)).astype(np.float32)
    plain, moved = begin(owner, skeleton=skeleton), begin(owner, skeleton=skeleton)
    wanted = send(owner, plain, offset=0, poses=walk.poses).json()
    found = send(owner, moved, offset=0, poses=walk.poses, translations=shifted, translated_joints=[child]).json()
    assert found["changed"] == wanted["changed"]
    slides = shifted.copy()
    slides[:, 0, 0] += 2.0 * np.arange(walk.frame_count) / RATE_HZ
    sliding = begin(owner, skeleton=skeleton)
    answer = send(owner, sliding, offset=0, poses=walk.poses, translations=slides, translated_joints=[child])
    assert answer.json()["performer"]["x_m"] != pytest.approx(wanted["performer"]["x_m"], abs=0.1)


def test_a_stream_is_made_once_per_key_and_deleted_for_good(owner: httpx.Client) -> None:
    key = {"Idempotency-Key": "stream-1"}
    first, again = (owner.post(STREAMS, json={"frame_rate_hz": 60}, headers=key) for _ in range(2))
    assert again.json() == first.json()
    assert first.headers["Location"] == f"/api/v1{STREAMS}/{first.json()['id']}"
    url = f"{STREAMS}/{first.json()['id']}"
    assert owner.delete(url).status_code == 204
    assert problem(owner.get(url), 404)["code"] == "no-stream"
    assert problem(owner.delete(url), 404)["code"] == "no-stream"


def test_readers_look_on_and_cannot_send(server: Server) -> None:
    reader = server.make_user("reader")
    owner = server.client(server.make_project("lab", reader=Role.READER))
    stream = begin(owner)
    guest = server.client(reader)
    assert guest.get(f"{STREAMS}/{stream['id']}").status_code == 200
    refused = send(guest, stream, offset=0, roots=circling(1.0, 0.0, 0.1))
    assert problem(refused, 403)["code"] == "insufficient-role"


def test_of_senders_who_send_at_once_one_is_taken(owner: httpx.Client) -> None:
    stream = begin(owner)
    roots = circling(1.0, 0.0, 1.0)
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda n: send(owner, stream, offset=0, roots=roots[: 10 + n]), range(8)))
    assert sorted(answer.status_code for answer in answers) == [200] + [409] * 7
    (taken,) = (answer.json()["offset"] for answer in answers if answer.status_code == 200)
    told = {answer.json()["context"]["offset"] for answer in answers if answer.status_code == 409}
    assert told == {taken}
    assert owner.get(f"{STREAMS}/{stream['id']}").json()["offset"] == taken
