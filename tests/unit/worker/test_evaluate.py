"""The function behind `evaluate`, with a project in memory instead of a server."""

import hashlib
from dataclasses import dataclass, field
from math import radians

import numpy as np
import pytest

from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.documents import RevisionRef
from marey_schemas.evaluation import EvaluateParams
from marey_schemas.items import Item
from marey_schemas.jobs import PinnedInput
from marey_schemas.kinds import Kind
from marey_worker.context import JobRefused, NoSuchThing, Task
from marey_worker.kinds import evaluate, matching_clips

NOW = "2026-01-01T00:00:00Z"
PARAMS = EvaluateParams(
    speeds_m_s=(1.0, 1.5), turn_rates_deg_s=(-50.0, 0.0, 50.0), duration_s=4.0, baseline=False, report=False
)


@dataclass
class ProjectInMemory:
    """What a job may use of its project: a context without a pipe."""

    scratch: object
    task: Task = field(default_factory=lambda: Task(0, 1))
    threads: int = 1
    inputs: dict = field(default_factory=dict)
    parts: dict = field(default_factory=dict)
    blobs: dict = field(default_factory=dict)
    staged: list = field(default_factory=list)
    told: list = field(default_factory=list)

    def document(self, kind, item, revision, part):
        if (item, revision, part) not in self.parts:
            raise NoSuchThing(f"{item} has no {part}")
        return self.parts[item, revision, part]

    def documents(self, pins, part, *, required=True):
        for pin in pins:
            held = self.parts.get((pin.item, pin.revision, part))
            assert held is not None or not required
            yield pin, held

    def item(self, kind, item):
        return Item(
            id=item, kind=kind, name=item.upper(), collection="rigs", revision=1, created_at=NOW, updated_at=NOW, rev=1
        )

    def blob(self, digest):
        return self.blobs[digest]

    def put_file(self, path):
        data = path.read_bytes()
        digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
        self.blobs[digest] = data
        return digest

    def stage(self, outputs):
        self.staged += outputs

    def progress(self, done, total=None, note=""):
        self.told.append((done, total, note))


def add_clip(project, name, clip, skeleton="skeleton_a"):
    ref = RevisionRef(item=skeleton, revision=1)
    project.parts[skeleton, 1, "hierarchy"] = skeleton_to_document(clip.skeleton).model_dump(by_alias=True)
    project.parts[f"clip_{name}", 1, "motion"] = clip_to_document(clip, ref).model_dump(by_alias=True)
    pin = PinnedInput(item=f"clip_{name}", revision=1, kind=Kind.CLIP, name=name, collection="walks")
    project.inputs["clips"] = (*project.inputs.get("clips", ()), pin)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """Three walks; nothing is kept of earlier tests."""
    monkeypatch.setattr(matching_clips, "_kept", matching_clips.Kept(1))
    made = ProjectInMemory(tmp_path)
    for turn_rate in (-50, 0, 50):
        add_clip(made, f"walk {turn_rate}", generate_gait(1.25, radians(turn_rate), 5.0))
    return made


def test_the_trials_of_all_tasks_together_are_the_suite_whatever_their_number(project):
    whole = evaluate.gather(project, PARAMS, [evaluate.run(project, PARAMS)])
    results = []
    for position in range(3):
        project.task = Task(position, 3)
        results.append(evaluate.run(project, PARAMS))
    assert [result["trials"] for result in results] == [4, 4, 4]
    gathered = evaluate.gather(project, PARAMS, results)
    assert {**gathered, "simulating_s": 0} == {**whole, "simulating_s": 0}
    first, second = (output.parts["records"] for output in project.staged)
    assert first["trials"] == second["trials"]
    np.testing.assert_array_equal(first["positions"], second["positions"])


def test_the_database_is_built_once_for_all_tasks_of_an_evaluation(project, monkeypatch):
    built: list[MatchingDatabase] = []
    build = matching_clips.build_database
    monkeypatch.setattr(
        matching_clips, "build_database", lambda *given, **more: built.append(build(*given, **more)) or built[-1]
    )
    for position in range(3):
        project.task = Task(position, 3)
        evaluate.run(project, PARAMS)
    assert len(built) == 1
    evaluate.run(project, PARAMS.model_copy(update={"loops": ("clip_walk 0",)}))
    assert len(built) == 2


def test_progress_is_told_trial_by_trial(project):
    project.task = Task(1, 3)
    evaluate.run(project, PARAMS)
    trials = [(done, total) for done, total, _ in project.told if total is not None]
    assert trials == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]


def test_clips_of_several_skeletons_are_refused_with_their_names(project):
    add_clip(project, "stranger", generate_gait(1.0, 0.0, 3.0), skeleton="skeleton_b")
    with pytest.raises(JobRefused, match=r"3 of 4 move rigs/SKELETON_A, but not walks/stranger") as refused:
        evaluate.run(project, PARAMS)
    assert refused.value.code == "several-skeletons"


def test_a_trial_that_is_not_in_the_suite_is_refused_before_anything_is_read(project):
    with pytest.raises(JobRefused, match="'circle v=9 w=0'; a name is like 'circle v=1 w=-50'"):
        evaluate.run(project, PARAMS.model_copy(update={"trial_figures": ("circle v=9 w=0",)}))
    assert project.told == []


def test_what_the_mathematics_refuses_is_not_tried_again(project):
    project.inputs["clips"] = project.inputs["clips"][:1] * 2
    with pytest.raises(JobRefused, match="the same uid"):
        evaluate.run(project, PARAMS)


def test_the_report_names_its_files_and_figures_of_the_trials_that_were_asked_for(project):
    wanted = PARAMS.model_copy(update={"report": True, "trial_figures": ("switching v=1 w=50",)})
    evaluate.gather(project, wanted, [evaluate.run(project, wanted)])
    report = project.staged[0].parts["report"]
    page = project.blobs[report["html"]["blob"]].decode()
    assert "walks/walk 50" in page
    assert len(report["scripts"]) == 1
    of_trial = {figure["name"] for figure in report["figures"] if figure["trial"] == "switching v=1 w=50"}
    assert {"scenario-switching", "errors", "transition-cost"} <= of_trial
    assert "scenario-circle" not in of_trial
    for figure in report["figures"]:
        assert project.blobs[figure["png"]["blob"]].startswith(b"\x89PNG")
