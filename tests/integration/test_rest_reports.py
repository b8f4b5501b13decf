"""Reports and figures of evaluations over HTTP: sent as they were stored, with a content security policy."""

import base64
import hashlib
import re
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import httpx
import pytest
from tests.support.evaluation_results import synthetic_result
from tests.support.present import present
from tests.support.rest_server import Server, stored_file

from marey_motion.evaluation.result_documents import records_to_tree, result_to_tree
from marey_schemas.documents.report_pages import ORIGIN_PLACE, PLAYER_PLACE
from marey_schemas.encoding.codecs import encode_tree
from marey_server.handlers import reports
from marey_server.handlers.browser import pages

PAGE = f"<!doctype html><title>Report</title><dl>{ORIGIN_PLACE}</dl><p>All is well.{PLAYER_PLACE}".encode()
PLAYER_SCRIPT = "sha256-" + "A" * 43 + "="
PLAYER = f"<meta content=\"script-src '{PLAYER_SCRIPT}'\"><title>Player</title>".encode()
SCRIPT = "sha256-" + base64.b64encode(hashlib.sha256(b"sort()").digest()).decode()
FILES = {"png": b"\x89PNG drawn", "svg": b"<svg/>", "json": b'{"tables": {}}', "csv": b"speed\n1.0\n"}
TYPES = {"png": "image/png", "svg": "image/svg+xml", "json": "application/json", "csv": "text/csv; charset=utf-8"}


@pytest.fixture
def evaluation(owner: httpx.Client) -> str:
    """The path of an evaluation with a report of two figures."""
    forms = {form: stored_file(owner, data) for form, data in FILES.items()}
    figure = {"title": "Offsets", "caption": "How far off.", **forms, "csv": {"cells": forms["csv"]}}
    report = {
        "schema": "marey/evaluation-report@1",
        "title": "walks",
        "html": stored_file(owner, PAGE),
        "scripts": [SCRIPT],
        "figures": [{"name": "offsets", **figure}, {"name": "errors", "trial": "circle v=1 w=0", **figure}],
    }
    parts = {
        "evaluation": {"schema": "marey/evaluation@1", "verdict": "Good.", "headline": {"offset_mean_m": 0.3}},
        "report": report,
    }
    made = owner.post("/projects/lab/evaluations", json={"name": "walks-eval", "parts": parts})
    assert made.status_code == 201, made.text
    return f"/projects/lab/evaluations/{made.json()['id']}"


def test_lists_show_the_verdict_and_the_headline_numbers(owner: httpx.Client, evaluation: str) -> None:
    (shown,) = owner.get("/projects/lab/evaluations").json()["items"]
    assert shown["summary"] == {"verdict": "Good.", "offset_mean_m": 0.3}


def test_a_report_is_a_page_that_may_run_its_own_script_and_do_nothing_else(
    owner: httpx.Client, evaluation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "FOLDER", tmp_path / "none")
    answer = owner.get(f"{evaluation}/report")
    assert answer.status_code == 200
    assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    policy = answer.headers["Content-Security-Policy"].split("; ")
    assert "default-src 'none'" in policy
    assert f"script-src '{SCRIPT}'" in policy
    assert "sandbox allow-scripts" in policy
    assert not any(rule.startswith("connect-src") for rule in policy)


def test_a_report_that_is_held_already_is_not_sent_again(owner: httpx.Client, evaluation: str) -> None:
    etag = owner.get(f"{evaluation}/report").headers["ETag"]
    again = owner.get(f"{evaluation}/report", headers={"If-None-Match": etag})
    assert (again.status_code, again.content) == (304, b"")


def test_browsers_ask_again_for_each_report_because_its_player_may_be_newer(
    owner: httpx.Client, evaluation: str
) -> None:
    for path in (f"{evaluation}/report?revision=1", f"{evaluation}/report"):
        assert owner.get(path).headers["Cache-Control"] == "private, no-cache"


def facts_of(page: str) -> dict[str, str]:
    """Return the facts in the head of a page by their names."""
    return dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", page))


def test_a_report_names_its_project_its_author_and_the_date_of_its_revision(
    server: Server, owner: httpx.Client, evaluation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rita = server.client(server.make_user("rita"))
    assert owner.put("/projects/lab/members/rita", json={"role": "reader"}).is_success
    made = owner.get(f"{evaluation}/revisions").json()["items"][0]
    for reader in (owner, rita):
        assert facts_of(reader.get(f"{evaluation}/report").text) == {
            "project": f"lab on {server.address}",
            "requested by": made["author"],
            "date": f"{made['created_at'][:10]} {made['created_at'][11:16]} UTC",
        }
    monkeypatch.setattr(reports, "MOST_FILLED_BYTES", len(PAGE) - 1)
    assert owner.get(f"{evaluation}/report").content == PAGE


def test_a_page_that_is_larger_than_stated_is_not_read_into_memory(owner: httpx.Client, evaluation: str) -> None:
    report = owner.get(f"{evaluation}/parts/report").json()
    report["html"]["size_bytes"] = 1
    assert owner.put(f"{evaluation}/parts/report", json=report, headers={"If-Match": "*"}).is_success
    answer = owner.get(f"{evaluation}/report")
    assert (answer.content, answer.headers["Accept-Ranges"]) == (PAGE, "bytes")  # streamed as it is stored


def test_a_report_gets_the_player_of_this_installation_and_may_run_its_script(
    owner: httpx.Client, evaluation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "FOLDER", tmp_path)
    bare = owner.get(f"{evaluation}/report")
    assert PLAYER_PLACE in bare.text
    assert f"script-src '{SCRIPT}';" in bare.headers["Content-Security-Policy"]
    (tmp_path / "index.html").write_text("")
    (tmp_path / "player.html").write_bytes(PLAYER)
    answer = owner.get(f"{evaluation}/report")
    (packed,) = re.findall(r'<script type="application/json" id="player">"([^"]*)"</script>', answer.text)
    assert zlib.decompress(base64.b64decode(packed)) == PLAYER
    assert f"script-src '{SCRIPT}' '{PLAYER_SCRIPT}';" in answer.headers["Content-Security-Policy"]
    assert answer.headers["ETag"] != bare.headers["ETag"]


@pytest.mark.parametrize("form", list(FILES))
def test_a_figure_comes_in_every_form(owner: httpx.Client, evaluation: str, form: str) -> None:
    answer = owner.get(f"{evaluation}/figures/offsets?format={form}")
    assert (answer.status_code, answer.content) == (200, FILES[form])
    assert answer.headers["Content-Type"] == TYPES[form]
    assert answer.headers["Content-Security-Policy"].endswith("; sandbox")


def test_figures_of_one_trial_are_asked_for_by_its_name(owner: httpx.Client, evaluation: str) -> None:
    assert owner.get(f"{evaluation}/figures/errors", params={"trial": "circle v=1 w=0"}).content == FILES["png"]
    missing = owner.get(f"{evaluation}/figures/errors", params={"trial": "circle v=9 w=0"})
    assert (missing.status_code, missing.json()["code"]) == (404, "no-figure")
    assert "circle v=1 w=0" in missing.json()["detail"]


def test_what_is_not_there_is_said_to_be_missing_with_what_there_is(owner: httpx.Client, evaluation: str) -> None:
    unknown = owner.get(f"{evaluation}/figures/portrait").json()
    assert (unknown["code"], "offsets, errors" in unknown["detail"]) == ("no-figure", True)
    table = owner.get(f"{evaluation}/figures/offsets?format=csv&table=rows").json()
    assert (table["code"], "cells" in table["detail"]) == ("no-table", True)
    assert owner.get(f"{evaluation}/report?revision=2").status_code == 404


def test_other_items_have_no_report(owner: httpx.Client) -> None:
    joints = [{"name": "hips", "parent": -1, "offset": [0, 1, 0]}]
    parts = {"hierarchy": {"schema": "marey/skeleton@1", "joints": joints}}
    made = owner.post("/projects/lab/skeletons", json={"name": "s", "parts": parts}).json()
    answer = owner.get(f"/projects/lab/skeletons/{made['id']}/report")
    assert answer.status_code == 404


@pytest.fixture
def walked(owner: httpx.Client) -> str:
    """The path of an evaluation that has records of its trials."""
    result = synthetic_result()
    trials = [each.trial for each in result.trials]
    parts = {"evaluation": result_to_tree(result), "records": records_to_tree(trials, result.records)}
    parts["evaluation"] |= {"verdict": "Good.", "headline": {}}
    body = encode_tree({"name": "walked", "parts": parts}, "application/msgpack")
    made = owner.post("/projects/lab/evaluations", content=body, headers={"Content-Type": "application/msgpack"})
    assert made.status_code == 201, made.text
    return f"/projects/lab/evaluations/{made.json()['id']}"


def read_graphml(data: bytes) -> tuple[list[Any], list[Any], dict[str, Any]]:
    """Read a walk graph without Marey: return its nodes, its edges, and its attributes by trial.

    Nodes are (clip, frame, ticks), and edges are (source, target, count).
    """
    space = {"g": "http://graphml.graphdrawing.org/xmlns"}
    root = ElementTree.fromstring(data)
    names = {key.get("id"): key.get("attr.name") for key in root.findall("g:key", space)}
    graph = root.find("g:graph", space)

    def values(element: Element) -> dict[Any, Any]:
        return {names[data.get("key")]: data.text for data in element.findall("g:data", space)}

    nodes = {node.get("id"): values(node) for node in present(graph).findall("g:node", space)}
    places = {name: place for place, name in enumerate(nodes)}
    edges = [
        (places[edge.get("source")], places[edge.get("target")], int(present(values(edge)["count"])))
        for edge in present(graph).findall("g:edge", space)
    ]
    return (
        [(one["clip"], int(present(one["frame"])), int(present(one["ticks"]))) for one in nodes.values()],
        edges,
        values(present(graph)),
    )


def test_a_walk_graph_is_the_same_in_json_and_in_graphml(owner: httpx.Client, walked: str) -> None:
    in_json, in_graphml = owner.get(f"{walked}/walk-graph"), owner.get(f"{walked}/walk-graph?format=graphml")
    assert in_json.headers["Content-Type"] == "application/json"
    assert in_graphml.headers["Content-Type"] == "application/graphml+xml"
    assert 'filename="walked-walks.graphml"' in in_graphml.headers["Content-Disposition"]
    graph = in_json.json()
    nodes, edges, walks = read_graphml(in_graphml.content)

    uids = [graph["clips"][clip]["uid"] for clip in graph["nodes"]["clip"]]
    assert nodes == list(zip(uids, graph["nodes"]["frame"], graph["nodes"]["ticks"], strict=True))
    assert edges == list(zip(*(graph["edges"][name] for name in ("source", "target", "count")), strict=True))
    assert list(walks) == graph["trials"]
    for text, walk in zip(walks.values(), graph["walks"], strict=True):
        assert [int(run.partition(":")[2]) for run in text.split()] == walk["frames"]
    ticks = sum(len(record.rows) for record in synthetic_result().records)
    assert sum(graph["nodes"]["ticks"]) == ticks == sum(sum(walk["frames"]) for walk in graph["walks"])


def test_a_walk_graph_of_one_trial_holds_its_walk_alone(owner: httpx.Client, walked: str) -> None:
    trial = synthetic_result().trials[0].trial.name
    graph = owner.get(f"{walked}/walk-graph", params={"trial": trial}).json()
    assert graph["trials"] == [trial]
    assert sum(graph["nodes"]["ticks"]) == sum(graph["walks"][0]["frames"]) == len(synthetic_result().records[0].rows)
    unknown = owner.get(f"{walked}/walk-graph", params={"trial": "hop"}).json()
    assert (unknown["code"], trial in unknown["detail"]) == ("no-trial", True)


def test_documents_that_contradict_each_other_give_no_walk_graph(owner: httpx.Client, evaluation: str) -> None:
    assert owner.get(f"{evaluation}/walk-graph").json()["status"] == 404
    result = synthetic_result()
    trials = [each.trial for each in result.trials]
    records = records_to_tree(trials, result.records)
    records["rows"] = records["rows"] + 10**6
    for number, tree in enumerate((result_to_tree(result), {"schema": "marey/evaluation@1"})):
        parts = {"evaluation": tree | {"verdict": "Good.", "headline": {}}, "records": records}
        body = encode_tree({"name": f"bad{number}", "parts": parts}, "application/msgpack")
        made = owner.post("/projects/lab/evaluations", content=body, headers={"Content-Type": "application/msgpack"})
        refused = owner.get(f"/projects/lab/evaluations/{made.json()['id']}/walk-graph")
        assert (refused.status_code, refused.json()["code"]) == (422, "not-a-walk")
        assert ("its documents are malformed (KeyError('clips'))" in refused.json()["detail"]) == (number == 1)
        assert refused.json()["detail"].endswith("Run the evaluation again.")


def test_strangers_learn_nothing_of_an_evaluation(server: Server, evaluation: str) -> None:
    stranger = server.client(server.make_user("mallory"))
    for path in ("report", "figures/offsets", "walk-graph"):
        answer = stranger.get(f"{evaluation}/{path}")
        assert (answer.status_code, answer.json()["code"]) == (404, "no-project")
