"""Studies for tests: a design of generated clips, and participants who take part in it over HTTP."""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

from marey_motion.arrays import Floats
from marey_motion.perception.fitting import PairDifferences
from marey_motion.perception.judging import simulate_judgements
from marey_motion.perception.study_analysis import StudyAnalysis, analyse_study, analysis_to_tree, metric_to_tree
from marey_reports.perception.study_page import render_study_report
from marey_schemas.documents.metrics import classes_of

Choice = Callable[[list[int]], tuple[int, int]]
"""Function that chooses two places, given the motions that are shown."""

HIERARCHY = {"schema": "marey/skeleton@1", "joints": [{"name": "root", "parent": -1, "offset": [0, 1, 0]}]}


def make_study(owner: httpx.Client, motions: int, **design: Any) -> str:
    """Create clips and a study of them in the project `lab`; return the id of the study."""
    skeleton = owner.post("/projects/lab/skeletons", json={"name": "rig", "parts": {"hierarchy": HIERARCHY}}).json()
    shown = []
    for number in range(motions):
        motion = {
            "schema": "marey/motion@1",
            "skeleton": {"item": skeleton["id"], "revision": 1},
            "frame_rate_hz": 30,
            "joints": ["root"],
            "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[number, 1, 0, 1, 0, 0, 0]]},
        }
        made = owner.post("/projects/lab/clips", json={"name": f"walk {number}", "parts": {"motion": motion}})
        shown.append({"clip": {"item": made.json()["id"], "revision": 1}, "label": f"W{number}"})
    study = {"schema": "marey/study@1", "title": "Walks", "consent_text": "I take part.", "motions": shown, **design}
    made = owner.post("/projects/lab/studies", json={"name": "walks", "parts": {"study": study}})
    assert made.status_code == 201, made.text
    identity: str = made.json()["id"]
    return identity


def make_links(owner: httpx.Client, study: str, count: int = 1, **body: Any) -> list[str]:
    """Create links of a study, and return their codes."""
    made = owner.post(f"/projects/lab/studies/{study}/participants", json={"count": count, **body})
    assert made.status_code == 201, made.text
    return [link["code"] for link in made.json()["links"]]


@dataclass
class Participant:
    """A participant with a token, who takes part over HTTP."""

    client: httpx.Client

    @classmethod
    def begin(cls, connect: Callable[[str | None], httpx.Client], code: str) -> Participant:
        """Consent, and exchange the code of a link for a token; `connect` returns a client that sends a token."""
        body = {"code": code, "key": secrets.token_hex(32), "consent": True}
        made = connect(None).post("/participation", json=body)
        assert made.status_code == 201, made.text
        return cls(connect(made.json()["token"]))

    def open(self) -> dict[str, Any]:
        """Return the step of the participant, with the open trial."""
        answer = self.client.post("/participation/trials")
        assert answer.status_code == 200, answer.text
        step: dict[str, Any] = answer.json()
        return step

    def answer(self, number: int, chosen: tuple[int, int], **body: Any) -> dict[str, Any]:
        """Answer a trial, and return what was recorded."""
        answer = self.client.put(f"/participation/trials/{number}", json={"chosen": chosen, **body})
        assert answer.status_code == 200, answer.text
        outcome: dict[str, Any] = answer.json()
        return outcome

    def answer_all(self, choose: Choice) -> None:
        """Answer all trials that are left."""
        while (step := self.open())["trial"] is not None:
            trial = step["trial"]
            self.answer(trial["number"], choose(trial["clips"]), client_fps=60.0)


def choice_by(differences: Floats, noise: float, seed: int) -> Choice:
    """Return a participant who chooses the pair with the smallest difference, with Gumbel noise."""
    draw = np.random.default_rng(seed)

    def choose(shown: list[int]) -> tuple[int, int]:
        pairs = [(a, b) for a in range(len(shown)) for b in range(a + 1, len(shown))]
        utility = [draw.gumbel(scale=noise) - differences[shown[a], shown[b]] for a, b in pairs]
        return pairs[int(np.argmax(utility))]

    return choose


def grouped_differences(sizes: tuple[int, int], seed: int) -> Floats:
    """Return the differences of motions in two groups, about six standard deviations apart."""
    draw = np.random.default_rng(seed)
    group = np.repeat((0, 1), sizes)
    points = draw.normal(size=(len(group), 2)) + np.where(group[:, None] == 1, (6.0, 0.0), 0.0)
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return np.asarray(distances / distances.max())


def analysis_of(motions: int) -> StudyAnalysis:
    """Return the analysis of simulated answers about motions of two groups, whose positions explain the answers."""
    group = np.arange(motions) // (motions // 2)
    table = np.where(np.eye(motions, dtype=bool), 0.0, 0.5 + 0.4 * (group[:, None] != group))
    ones, others = np.triu_indices(motions, 1)
    draw, pairs = np.random.default_rng(2), np.stack((ones, others), axis=1).astype(np.int64)
    frames = tuple(draw.gamma(2.0, 0.04, (30, 8)) + 0.2 * (group[i] != group[j]) for i, j in pairs)
    measured = PairDifferences("positions", classes_of("positions"), pairs, frames)
    return analyse_study(simulate_judgements(table, 6, seed=1, noise=0.1), [measured], name="walks", draws=0, seed=3)


def files_of(analysis: StudyAnalysis, study: dict[str, Any]) -> dict[str, bytes]:
    """Return the files that a job stores for an analysis of a revision of a study, by name."""
    names = [f"motion {number}" for number in range(analysis.judgements.motion_count)]
    return {
        "document": json.dumps(analysis_to_tree(analysis, study)).encode(),
        "fitted": json.dumps(metric_to_tree(analysis, analysis.fits[0], study)).encode(),
        "report": render_study_report(analysis, names, title="Walks").encode(),
    }


def finish_analysis(owner: httpx.Client, worker: httpx.Client, study: str) -> str:
    """Submit the analysis of a study of seven motions, end it as a worker does, and return the id of the job."""
    body = {"kind": "analyse_study", "inputs": {"study": {"item": study}}}
    assert owner.post("/projects/lab/jobs", json=body).status_code == 202
    claim = {"worker": "w", "kinds": ["analyse_study"], "max": 1}
    (lease,) = worker.post("/leases", json=claim).json()["leases"]
    own = {"Authorization": f"Bearer {lease['attempt_token']}"}
    result = {}
    for name, content in files_of(analysis_of(7), {"item": study, "revision": 1}).items():
        digest = f"sha256:{hashlib.sha256(content).hexdigest()}"
        assert worker.put(f"/blobs/{digest}", content=content, headers=own).is_success
        result[name] = {"blob": digest, "size_bytes": len(content)}
    address = f"/jobs/{lease['job']}/attempts/{lease['fence']}/complete"
    ended = worker.post(address, json={"write_id": "12345678", "result": result}, headers=own)
    assert ended.is_success, ended.text
    return str(lease["job"])
