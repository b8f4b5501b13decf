"""Recordings that the SDK sends to coverage streams: each frame is sent once, from the offset of the last answer on."""

from datetime import UTC, datetime
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.scripted_server import ScriptedServer, problem

from marey_client.errors import Conflict, RequestFailed
from marey_client.handles.coverage_streams import CoverageStreamHandle, CoverageStreams
from marey_schemas.encoding.codecs import decode_tree

NOW = datetime(2026, 1, 1, tzinfo=UTC).isoformat()
STREAM = {
    "id": "coverage_1", "frame_rate_hz": 60.0, "skeleton": None, "evaluation": None, "speeds_m_s": [1.0],
    "turn_rates_deg_s": [0.0], "least_s": 1.0, "target_count": 3, "path_s": 4.0, "offset": 0, "created_at": NOW,
    "updated_at": NOW, "expires_at": NOW, "rev": 1,
}  # fmt: skip
URL = "/api/v1/projects/lab/coverage-streams"


def said(request: httpx.Request) -> dict[str, Any]:
    return decode_tree(request.content, request.headers["Content-Type"])


def counted(request: httpx.Request) -> httpx.Response:
    """Return the answer of a server that has accepted the frames of the request."""
    frames = said(request)
    count = sum(len(frames[name]) for name in ("poses", "roots") if name in frames)
    body = {
        "offset": frames["offset"] + count, "windows": 0, "changed": [], "index": 0.0, "missing_s": 1.0, "targets": [],
        "performer": None,
    }  # fmt: skip
    return httpx.Response(200, json=body)


@pytest.fixture
def streams(script: ScriptedServer) -> CoverageStreams:
    return script.marey().project("lab").coverage_streams


@pytest.fixture
def stream(script: ScriptedServer, streams: CoverageStreams) -> CoverageStreamHandle:
    script.answers = [httpx.Response(201, json=STREAM)]
    return streams.begin(60.0, skeleton="skeleton_1", turn_rates_deg_s=(-90, 0, 90))


def test_what_is_asked_for_is_sent_and_checked_before(
    script: ScriptedServer, streams: CoverageStreams, stream: CoverageStreamHandle
) -> None:
    (request,) = script.requests
    assert (request.method, request.url.path) == ("POST", URL)
    assert decode_tree(request.content, "application/json") == {
        "frame_rate_hz": 60.0, "skeleton": "skeleton_1", "evaluation": None, "turn_rates_deg_s": [-90, 0, 90],
    }  # fmt: skip
    with pytest.raises(ValueError, match="at most 240"):
        streams.begin(1000.0)
    assert len(script.requests) == 1


def test_frames_go_on_where_the_last_answer_left_them(script: ScriptedServer, stream: CoverageStreamHandle) -> None:
    script.answers = [counted] * 4
    poses = np.zeros((10, 107), np.float32)
    stream.send(poses)
    stream.send(poses[:4], translations=np.ones((4, 1, 3), np.float32), translated_joints=("Hips",), ends_take=True)
    stream.send(np.zeros((6, 3)))
    stream.end_take()
    sent = [said(request) for request in script.requests[1:]]
    assert [one["offset"] for one in sent] == [0, 10, 14, 20]
    assert [one["ends_take"] for one in sent] == [False, True, False, True]
    assert sent[1]["translated_joints"] == ["Hips"]
    assert (sent[2]["roots"].shape, sent[2]["roots"].dtype) == ((6, 3), np.float64)
    assert np.array_equal(sent[0]["poses"], poses)
    assert stream.offset == 20


def test_frames_whose_answer_was_lost_are_sent_again_as_they_were(
    script: ScriptedServer, stream: CoverageStreamHandle
) -> None:
    script.answers = [httpx.ReadError("connection reset"), counted]
    stream.send(np.zeros((10, 3)))
    first, again = script.requests[1:]
    assert first.content == again.content
    assert stream.offset == 10


def test_frames_that_are_refused_leave_the_offset_where_it_was(
    script: ScriptedServer, stream: CoverageStreamHandle
) -> None:
    script.answers = [problem(409, "coverage-offset", context={"offset": 30}), problem(422, "invalid")]
    with pytest.raises(Conflict) as refused:
        stream.send(np.zeros((10, 3)))
    assert refused.value.problem.context == {"offset": 30}
    with pytest.raises(RequestFailed):
        stream.send(np.zeros((10, 3)))
    assert stream.offset == 0


def test_another_process_goes_on_with_a_stream(script: ScriptedServer, streams: CoverageStreams) -> None:
    script.answers = [httpx.Response(200, json={**STREAM, "offset": 700}), counted]
    stream = streams.get("coverage_1")
    stream.send(np.zeros((10, 3)))
    assert said(script.requests[-1])["offset"] == 700


def test_streams_are_listed_read_and_dropped(
    script: ScriptedServer, streams: CoverageStreams, stream: CoverageStreamHandle
) -> None:
    state = {
        **STREAM, "index": 0.0, "missing_s": 1.0, "targets": [], "performer": None, "seconds": [[0.0]],
        "deficit_s": [[1.0]], "delay_s": 0.5,
    }  # fmt: skip
    script.answers = [
        httpx.Response(200, json={"items": [STREAM]}), httpx.Response(200, json=state), httpx.Response(204),
    ]  # fmt: skip
    assert [one.id for one in streams.list()] == ["coverage_1"]
    assert stream.read().deficit_s == ((1.0,),)
    stream.delete()
    assert (script.requests[-1].method, script.requests[-1].url.path) == ("DELETE", f"{URL}/coverage_1")
