"""The function of the job kind `evaluate`, with a project in memory instead of a server."""

from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_results import synthetic_result
from tests.support.project_in_memory import PARAMS, ProjectInMemory, add_clip

from marey_motion.gait import generate_gait
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.documents.evaluations import HEADLINE_METRICS
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import count_evaluation_tasks
from marey_worker.context import JobRefused, Task
from marey_worker.job_io import matching_clips
from marey_worker.kinds import evaluate


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ProjectInMemory:
    """A project with three walks, and without cached skeletons of earlier tests."""
    monkeypatch.setattr(matching_clips, "_cache", LruCache(max_entries=1))
    made = ProjectInMemory(tmp_path)
    for turn_rate in (-50, 0, 50):
        add_clip(made, f"walk {turn_rate}", generate_gait(1.25, radians(turn_rate), 5.0))
    return made


def test_the_trials_of_all_tasks_together_are_the_suite_whatever_their_number(project: ProjectInMemory) -> None:
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


def test_tasks_are_without_trials_if_there_are_fewer_takes_than_allowed(project: ProjectInMemory) -> None:
    params = PARAMS.model_copy(update={"families": ("takes",), "most_takes": 40, "replicates": 3})
    assert count_evaluation_tasks(params) == 5
    results = []
    for position in range(5):
        project.task = Task(position, 5)
        results.append(evaluate.run(project, params))
    assert [result["trials"] for result in results] == [1, 1, 1, 0, 0]
    evaluate.gather(project, params, results)
    (output,) = project.staged
    names = [trial["trial"]["label"] for trial in output.parts["evaluation"]["trials"]]
    assert names == [pin.path for pin in project.inputs["clips"]]


def test_the_database_is_built_once_for_all_tasks_of_an_evaluation(
    project: ProjectInMemory, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[MatchingDatabase] = []

    def build(*given: Any, **more: Any) -> MatchingDatabase:
        built.append(build_database(*given, **more))
        return built[-1]

    monkeypatch.setattr(matching_clips, "build_database", build)
    for position in range(3):
        project.task = Task(position, 3)
        evaluate.run(project, PARAMS)
    assert len(built) == 1
    evaluate.run(project, PARAMS.model_copy(update={"loops": ("clip_walk 0",)}))
    assert len(built) == 2


def test_progress_is_told_trial_by_trial(project: ProjectInMemory) -> None:
    project.task = Task(1, 3)
    evaluate.run(project, PARAMS)
    trials = [(done, total) for done, total, _ in project.told if total is not None]
    assert trials == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]


def test_clips_of_several_skeletons_are_refused_with_their_names(project: ProjectInMemory) -> None:
    add_clip(project, "stranger", generate_gait(1.0, 0.0, 3.0), skeleton="skeleton_b")
    with pytest.raises(JobRefused, match=r"3 of 4 have rigs/SKELETON_A, but walks/stranger do not") as refused:
        evaluate.run(project, PARAMS)
    assert refused.value.code == "several-skeletons"


def test_trials_of_one_name_are_refused_although_other_tasks_have_them(project: ProjectInMemory) -> None:
    project.task = Task(0, 12)
    with pytest.raises(JobRefused, match="two trials are called circle v=1 w=-50"):
        evaluate.run(project, PARAMS.model_copy(update={"speeds_m_s": (1.0, 1.0 + 1e-9)}))
    assert project.told == []


def test_a_trial_that_is_not_in_the_suite_is_refused_before_anything_is_read(project: ProjectInMemory) -> None:
    with pytest.raises(JobRefused, match="'circle v=9 w=0'; a name is like 'circle v=1 w=-50'"):
        evaluate.run(project, PARAMS.model_copy(update={"trial_figures": ("circle v=9 w=0",)}))
    assert project.told == []


def test_what_the_mathematics_refuses_is_not_tried_again(project: ProjectInMemory) -> None:
    project.inputs["clips"] = project.inputs["clips"][:1] * 2
    with pytest.raises(JobRefused, match="the same uid"):
        evaluate.run(project, PARAMS)


def test_the_headline_counts_the_clips_and_those_that_no_trial_plays() -> None:
    headline = evaluate.headline_of(synthetic_result(clips=6, unused=2))
    assert (headline["clips"], headline["unused_clips"]) == (6, 2)
    assert list(headline) == list(HEADLINE_METRICS)


def test_the_use_of_each_clip_is_published_as_its_facets(project: ProjectInMemory) -> None:
    evaluate.gather(project, PARAMS, [evaluate.run(project, PARAMS)])
    (output,) = project.staged
    usage = output.parts["evaluation"]["usage"]
    facets = {one.item: one.values for one in project.facets}
    assert facets.keys() == {pin.item for pin in project.inputs["clips"]}
    assert {one.revision for one in project.facets} == {1}
    assert sum(values["usage"] for values in facets.values()) == pytest.approx(sum(usage["share"]))
    assert all(0 <= values["used_frames"] <= 1 for values in facets.values())
    assert any(values["used_frames"] > 0 for values in facets.values())
    assert all((values["usage"] > 0) == (values["used_frames"] > 0) for values in facets.values())


def test_the_report_names_its_files_and_figures_of_the_trials_that_were_asked_for(project: ProjectInMemory) -> None:
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
