"""Evaluations in the SDK and on the command line: requests and output."""

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.scripted_server import ScriptedServer, folder

from marey_client.cli.addresses import Address
from marey_client.cli.evaluations import clips_in
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.typed_values import named_number, read_numbers
from marey_client.handles.evaluations import clip_rows, record_arrays, trial_rows
from marey_client.progress import show_progress
from marey_schemas.queue.jobs import CollectionInput, Job, Progress

NOW = datetime(2026, 1, 1, tzinfo=UTC).isoformat()


def clip(name: str, *, skeleton: str = "skeleton_1", tags: Sequence[str] = ()) -> dict[str, Any]:
    return {
        "id": f"clip_{name}", "kind": "clip", "name": name, "collection": "walks", "tags": list(tags), "revision": 1,
        "summary": {"skeleton": skeleton}, "created_at": NOW, "updated_at": NOW, "rev": 1,
    }  # fmt: skip


def skeleton(revision: int) -> dict[str, Any]:
    made = clip("s")
    return {**made, "id": "skeleton_1", "kind": "skeleton", "revision": revision, "summary": {}}


def job(**fields: Any) -> dict[str, Any]:
    return {
        "id": "job_1", "project": "lab", "kind": "evaluate", "state": "queued", "params": {}, "inputs": {}, "into": "",
        "priority": 0, "seed": 0, "attempt": 0, "fence": 0, "max_attempts": 3, "author": "ann", "created_at": NOW,
        "run_at": NOW, "rev": 1, **fields,
    }  # fmt: skip


def answer(request: httpx.Request) -> httpx.Response:
    """Answer as a server whose project has three clips of one skeleton.

    One clip is tagged as a loop, and the mapping of the skeleton was edited.
    """
    path, query = request.url.path, dict(request.url.params)
    if path.endswith("/jobs"):
        return httpx.Response(202, json=job())
    if path.endswith("/collections"):
        return folder(query["path"])
    if path.endswith("/evaluations"):
        made = clip("7")
        return httpx.Response(200, json={"items": [{**made, "id": "evaluation_7", "kind": "evaluation"}]})
    if path.endswith("/skeletons/skeleton_1"):
        return httpx.Response(200, json=skeleton(revision=2))
    found = [clip("a"), clip("b", tags=["loop"]), clip("c")]
    if "tag.in" in query:
        found = [one for one in found if query["tag.in"] in one["tags"]]
    return httpx.Response(200, json={"items": found})


def submitted(script: ScriptedServer) -> dict[str, Any]:
    return json.loads(script.requests[-1].content)


def test_a_folder_is_evaluated_with_its_tagged_loops_and_the_edited_mapping(script: ScriptedServer) -> None:
    script.answers = [answer] * 9
    script.marey().project("lab").evaluate("walks", into="results", name="walks-eval", duration_s=10)
    sent = submitted(script)
    assert (sent["kind"], sent["into"]) == ("evaluate", "results")
    assert sent["inputs"] == {
        "clips": [{"collection": "walks"}],
        "rig": {"item": "skeleton_1"},
    }
    assert sent["params"] == {"name": "walks-eval", "duration_s": 10.0, "loops": ["clip_b"]}


def test_the_clips_of_a_folder_are_in_the_order_of_their_paths(script: ScriptedServer) -> None:
    def newest_first(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/collections"):
            return folder("walks")
        is_item = "path" in request.url.params  # the lookup of an item at the path
        return httpx.Response(200, json={"items": [] if is_item else [clip("c"), clip("a"), clip("b")]})

    script.answers = [newest_first] * 9
    found = clips_in(script.marey(), Address.parse("lab/walks"))
    assert [one.path for one in found] == ["walks/a", "walks/b", "walks/c"]


def test_loops_that_are_named_and_a_normaliser_are_handed_in(script: ScriptedServer) -> None:
    script.answers = [answer] * 9
    places = [CollectionInput(collection="walks")]
    script.marey().project("lab").evaluate(places, normaliser="evaluation_7", loops=["clip_a"], cache="refresh")
    sent = submitted(script)
    assert sent["params"]["loops"] == ["clip_a", "clip_b"]
    assert sent["inputs"]["normaliser"]["item"] == "evaluation_7"
    assert sent["cache"] == "refresh"


def test_a_misspelt_option_is_refused_before_anything_is_sent(script: ScriptedServer) -> None:
    with pytest.raises(ValueError, match="durations_s"):
        script.marey().project("lab").evaluate("walks", **dict[str, Any](durations_s=10))
    assert script.requests == []


TRIAL = {"family": "circle", "speed_m_s": 1.25, "turn_rate_rad_s": math.radians(-50)}
DOCUMENT = {
    "trials": [{"trial": TRIAL, "metrics": {"offset_mean": 0.5, "response_s": None}, "regimes": {}}],
    "clips": [
        {"name": "walk", "uid": "clip_a@1", "start": 0, "stop": 90, "loop": False, "mirrored_from": None},
        {"name": "walk", "uid": "clip_a@1~mirrored", "start": 90, "stop": 180, "loop": False, "mirrored_from": "x"},
    ],
    "usage": {
        "ticks": np.array([3, 0]),
        "share": np.array([1.0, 0.0]),
        "entries": np.array([2, 0]),
        "trials": np.array([1, 0]),
    },
}


def test_trials_and_clips_come_as_flat_rows() -> None:
    (trial,) = trial_rows(DOCUMENT)
    assert trial["trial"] == "circle v=1.25 w=-50"
    assert (trial["turn_rate_deg_s"], trial["offset_mean"], trial["response_s"]) == (pytest.approx(-50), 0.5, None)
    used, unused = clip_rows(DOCUMENT)
    assert (used["clip"], used["frames"], used["ticks"], used["mirrored"]) == ("walk", 90, 3, False)
    assert (unused["ticks"], unused["mirrored"]) == (0, True)


def test_records_come_per_trial_with_gaps_where_a_cost_is_not_defined() -> None:
    cost = {"ticks": np.array([1, 3], dtype=np.int32), "values": np.array([0.25, 0.75])}
    document = {
        "trials": ["one", "two"],
        "starts": np.array([0, 2, 5]),
        "rows": np.arange(5, dtype=np.int32),
        "positions": np.zeros((5, 2)),
        "headings": np.zeros(5),
        "status": np.zeros(5, dtype=np.int8),
        "match_cost": cost,
        "continuing_cost": cost,
        "pose_cost": cost,
    }
    records = record_arrays(document)
    assert list(records) == ["one", "two"]
    assert records["two"]["rows"].tolist() == [2, 3, 4]
    np.testing.assert_array_equal(records["one"]["match_cost"], [np.nan, 0.25])
    np.testing.assert_array_equal(records["two"]["match_cost"], [np.nan, 0.75, np.nan])


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1:3:0.25", tuple(1 + 0.25 * n for n in range(9))),
        ("-100:100:50", (-100, -50, 0, 50, 100)),
        ("1:2:0.4", (1, 1.4, 1.8)),
        ("2", (2,)),
        ("1,2.5,2", (1, 2.5, 2)),
    ],
)
def test_ranges_hold_their_last_value_where_the_steps_meet_it(text: str, values: tuple[Any, ...]) -> None:
    assert read_numbers(text) == pytest.approx(values)


@pytest.mark.parametrize("text", ["1:3", "3:1:1", "1:3:0", "fast", "1:3:0.25:2", "1:2,3:1", "0:1:0.0001", ""])
def test_ranges_that_make_no_sense_are_refused_with_what_to_write(text: str) -> None:
    with pytest.raises(WrongUsage, match=r"write|range|values"):
        read_numbers(text)


def test_progress_of_tasks_is_shown_in_trials() -> None:
    told = []
    running = Job.model_validate(
        job(state="running", size=4, children={"succeeded": 1}, progress=Progress(done=1.5, total=4).model_dump())
    )
    show_progress(running, lambda *seen: told.append(seen), count=32, unit="trials")
    gathering = Job.model_validate(
        job(state="running", size=4, progress=Progress(done=1, total=3, note="drawing").model_dump())
    )
    show_progress(gathering, lambda *seen: told.append(seen), count=32, unit="trials")
    assert told == [("trials", 12, 32), ("drawing", 1, 3)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed", "'speed' does not have the form name=number; the names are hips, head"),
        ("hipps=1", "'hipps=1' begins with an unknown name; the names are hips, head"),
        ("hips=fast", "'hips=fast': 'fast' is not a number"),
    ],
)
def test_a_wrong_name_and_a_wrong_form_are_told_apart(text: str, message: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        named_number(text, {"hips": None, "head": None})
    assert str(refused.value) == message
