"""Commands that submit jobs, against a simulated server: their requests, printed results and written files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer

from marey_client.cli import improvements
from marey_client.cli.perception import quality
from marey_client.cli.queue import pipelines
from marey_client.cli.studies import results
from marey_client.handles.studies import StudyHandle
from marey_schemas.documents.quality import MAIN_MEASURE, MEASURES
from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind

AT = {"created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z", "rev": 1}
REPORT = b"<html>differences</html>"


def item(kind: Kind, path: str) -> dict[str, Any]:
    folder, _, name = path.rpartition("/")
    summary = {"skeleton": "skeleton_slim"} if kind is Kind.CLIP else {}
    place = {"name": name, "collection": folder, "revision": 2}
    return {"id": f"{kind}_{name}", "kind": kind, "summary": summary, **place, **AT}


def path_of(one: Mapping[str, Any]) -> str:
    return f"{one['collection']}/{one['name']}".lstrip("/")


def blob(content: bytes) -> dict[str, Any]:
    return {"blob": digest_of(content), "size_bytes": len(content)}


@dataclass
class Lab:
    """A project with items, whose jobs all end at once with the same result; `submitted` are the bodies of requests."""

    items: Mapping[str, Kind]
    result: Mapping[str, Any] = field(default_factory=dict)
    blobs: tuple[bytes, ...] = ()
    submitted: list[dict[str, Any]] = field(default_factory=list)

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path.removeprefix("/api/v1")
        if request.method == "POST":
            self.submitted.append(json.loads(request.content))
            steps = self.submitted[-1].get("steps")
            return httpx.Response(202, json=self.job() if steps is None else {"jobs": dict.fromkeys(steps, self.job())})
        if path.startswith("/blobs/"):
            return httpx.Response(200, content={digest_of(one): one for one in self.blobs}[path.split("/")[2]])
        if path.endswith("/files/report"):
            return httpx.Response(200, content=REPORT)
        if path == "/jobs/job_1":
            return httpx.Response(200, json=self.job())
        known = [item(kind, one) for one, kind in self.items.items()]
        if alone := [one for one in known if path.endswith(f"/{one['id']}")]:
            return httpx.Response(200, json=alone[0])
        asked = request.url.params.get("path")
        found = [one for one in known if path.endswith(f"/{one['kind'].plural}") and asked in (None, path_of(one))]
        return httpx.Response(200, json={"items": found, "next_cursor": None})

    def job(self) -> dict[str, Any]:
        return {
            "id": "job_1", "project": "lab", "kind": "any", "state": "succeeded", "params": {}, "inputs": {},
            "into": "", "priority": 0, "seed": 0, "attempt": 1, "fence": 1, "max_attempts": 3, "author": "ann",
            "run_at": "2026-01-01T00:00:00Z", "result": self.result, **AT,
        }  # fmt: skip


@dataclass(frozen=True)
class Commands:
    """Commands that send their requests to a simulated server."""

    script: ScriptedServer
    patch: pytest.MonkeyPatch

    def __call__(self, module: Any, lab: Lab, *words: object) -> CompletedProcess[str]:
        self.patch.setattr(module, "connect", lambda _: self.script.marey())
        self.script.answers = [lab] * 50
        return run_here(list(map(str, words)))


@pytest.fixture
def run(script: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> Commands:
    return Commands(script, monkeypatch)


# -- studies ----------------------------------------------------------------------------------------------------------

ANALYSIS = json.dumps({"schema": "marey/study-analysis@1", "refusals": ["too few pairs for a metric"]}).encode()


@pytest.fixture
def studied() -> Lab:
    files = {"document": blob(ANALYSIS), "report": blob(REPORT)}
    return Lab({"walks": Kind.STUDY}, {"participants": 12, "agreement": 0.75, **files}, (ANALYSIS,))


def test_the_analysis_of_a_study_is_printed_and_its_report_is_written(
    run: Commands, studied: Lab, tmp_path: Path
) -> None:
    done = run(results, studied, "study", "analyse", "lab/walks", "--out", tmp_path / "walks.html")
    assert done.returncode == 0, done
    assert done.stdout.split() == ["participants", "12", "agreement", "0.75"]
    assert "too few pairs for a metric" in done.stderr
    assert (tmp_path / "walks.html").read_bytes() == REPORT
    (request,) = studied.submitted
    assert (request["kind"], request["inputs"]) == ("analyse_study", {"study": {"item": "study_walks", "revision": 2}})
    done = run(results, studied, "study", "analyse", "lab/walks", "--metric", tmp_path / "metric.json")
    assert done.returncode == 2
    assert "no metric was fitted: too few pairs for a metric" in done.stderr


def test_an_analysis_that_is_not_waited_for_prints_its_job(run: Commands, studied: Lab, tmp_path: Path) -> None:
    done = run(results, studied, "study", "analyse", "lab/walks", "--no-wait")
    assert (done.returncode, done.stdout, done.stderr) == (0, "job_1\n", "")
    done = run(results, studied, "study", "analyse", "lab/walks", "--no-wait", "--out", tmp_path / "walks.html")
    assert "--no-wait does not wait for them" in " ".join(done.stderr.split())
    assert done.returncode == 2
    assert not list(tmp_path.iterdir())


def test_the_analysis_of_a_study_is_read_in_the_sdk(script: ScriptedServer, studied: Lab) -> None:
    script.answers = [studied] * 10
    (study,) = script.marey().project("lab").studies.list()
    assert isinstance(study, StudyHandle)
    found = study.analyse()
    assert found.summary == {"participants": 12, "agreement": 0.75}
    assert found.document()["refusals"] == ["too few pairs for a metric"]
    assert found.report() == REPORT


# -- models -----------------------------------------------------------------------------------------------------------


def test_takes_are_retargeted_only_to_a_skeleton_that_was_given(run: Commands) -> None:
    lab = Lab({"raw/walk": Kind.CLIP, "rigs/slim": Kind.SKELETON})
    words = ("build-model", "lab/raw/walk", "--name", "gait", "--propose", "steps", "--no-wait")
    done = run(pipelines, lab, *words, "--to", "lab/rigs/slim")
    assert done.returncode == 0, done
    (steps,) = (one["steps"] for one in lab.submitted)
    assert steps["retarget"]["inputs"]["skeleton"] == {"item": "skeleton_slim"}
    assert "model" in done.stdout
    lab.submitted.clear()
    done = run(pipelines, lab, *words)
    assert done.returncode == 0, done
    (steps,) = (one["steps"] for one in lab.submitted)
    assert "retarget" not in steps


# -- quality ----------------------------------------------------------------------------------------------------------


def total(value: float, low: float | None, high: float | None) -> dict[str, Any]:
    return {"value": value, "low": low, "high": high, "clips": 2, "takes": 2, "seconds": 4.0}


def test_an_interval_is_printed_only_if_it_is_known(run: Commands) -> None:
    totals = {name: total(0.5, None, None) for name in MEASURES} | {MAIN_MEASURE: total(0.125, 0.1, 0.1504)}
    row = {
        "item": "clip_walk", "revision": 1, "name": "raw/walk", "take": "walk", "seconds": 2.0, "frames": 60,
        "frame_rate_hz": 30.0, "values": dict.fromkeys(MEASURES, 0.5),
    }  # fmt: skip
    document = {
        "code_version": "1", "conditions": {"options": {}, "draws": 0, "seed": 0}, "units": {},
        "measured": {"clips": [row], "totals": totals, "speed_seconds": [], "turn_seconds": []},
    }  # fmt: skip
    content = json.dumps(document).encode()
    lab = Lab({"raw/walk": Kind.CLIP, "rigs/slim": Kind.SKELETON}, {"document": blob(content)}, (content,))
    done = run(quality, lab, "quality", "lab/raw/walk")
    assert done.returncode == 0, done
    assert "0.125 0.100 to 0.150" in " ".join(done.stdout.split())
    assert done.stdout.count(" to ") == 1


# -- evaluations ------------------------------------------------------------------------------------------------------


def test_clips_without_effect_are_written_to_a_file_only_if_one_was_given(
    run: Commands, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(improvements, "_print_suggestions", lambda *_: None)
    content = json.dumps({"unused": {"clips": [{"name": "raw/idle"}, {"name": "raw/wave"}]}}).encode()
    lab = Lab({"walks": Kind.EVALUATION}, {"document": blob(content)}, (content,))
    done = run(improvements, lab, "suggest", "lab/walks", "--remove-out", tmp_path / "names")
    assert done.returncode == 0, done
    assert (tmp_path / "names").read_text() == "raw/idle\nraw/wave\n"
    assert "2 clips that can be removed" in done.stderr
    done = run(improvements, lab, "suggest", "lab/walks")
    assert done.returncode == 0, done
    assert "can be removed" not in done.stderr


def test_suggestions_of_an_older_worker_which_do_not_compare_the_quality_are_printed(run: Commands) -> None:
    filling = {"reason": "“raw/turn” contains 4.0 s of the missing data."}
    found = {
        "unused": {"clips": [], "ranges": [], "confirmed_clips": None, "confirmed_ranges": None},
        "redundant": {"plan": [], "tried": 0, "needed": 0},
        "near_duplicates": {"pairs": [], "spared": [], "threshold_cm": 2.0},
        "fillings": [filling], "additions": [], "chance": {}, "similarity": {"share": None}, "unusable": [],
    }  # fmt: skip
    content = json.dumps(found).encode()
    lab = Lab({"walks": Kind.EVALUATION}, {"document": blob(content)}, (content,))
    done = run(improvements, lab, "suggest", "lab/walks")
    assert (done.returncode, done.stdout.split("\n")) == (
        0, ["1 clip would fill gaps in the coverage.", f"  {filling['reason']}", "", ""],
    )  # fmt: skip
