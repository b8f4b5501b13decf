"""Pipelines: all jobs of a pipeline are submitted or none; a job starts when the jobs that it needs have succeeded."""

from typing import Any

import pytest
from tests.support.queue_desk import Desk

from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import Job
from marey_schemas.queue.pipelines import PipelineCreate
from marey_server.errors import InvalidProblem
from marey_server.store import blobs, items
from marey_server.store.jobs import reading
from marey_server.store.jobs.submission import submit_pipeline


def submit(desk: Desk, steps: dict[str, Any], **shared: Any) -> dict[str, Job]:
    wanted = PipelineCreate.model_validate({"steps": steps, **shared})
    return desk.database.write(desk.user, submit_pipeline, "lab", wanted).jobs


def chain(number: int = 0) -> dict[str, Any]:
    return {
        "survey": {
            "kind": "survey",
            "inputs": {"things": [{"step": "square"}, {"step": "sum"}]},
            "params": {"number": 2},
        },
        "square": {"kind": "square", "inputs": {"things": {"step": "sum"}}, "into": "squared"},
        "sum": {"kind": "sum", "params": {"number": number}, "into": "made"},
    }


def work_off(desk: Desk) -> int:
    """Complete all jobs that can be claimed; return the number of attempts."""
    attempts = 0
    while leases := desk.claim_many():
        for lease in leases:
            attempts += 1
            given = [pin.name for pin in lease.inputs.get("things", ())]
            made = {"sum": ["a", "b", "c"], "square": [f"{name}2" for name in given], "survey": ["overview"]}
            if lease.kind != "survey" or lease.position is None:
                desk.stage(lease, *made[lease.kind])
            desk.complete(lease)
    return attempts


def test_the_jobs_of_a_pipeline_work_on_what_others_of_them_make(desk: Desk) -> None:
    made = submit(desk, chain(), into="shared")
    assert [(name, job.kind, job.state) for name, job in made.items()] == [
        ("sum", "sum", "queued"),
        ("square", "square", "waiting"),
        ("survey", "survey", "waiting"),
    ]
    assert made["survey"].inputs == {"things": [{"job": made["square"].id}, {"job": made["sum"].id}]}
    assert set(made["survey"].after) == {made["square"].id, made["sum"].id}
    assert work_off(desk) == 1 + 2 + 2 + 1
    assert {desk.state(job.id) for job in made.values()} == {"succeeded"}
    assert [pin["name"] for pin in desk.job(made["survey"].id).inputs["things"]] == ["a2", "b2", "c2", "a", "b", "c"]


def test_a_pipeline_handed_in_again_is_done_at_once(desk: Desk) -> None:
    submit(desk, chain())
    work_off(desk)
    again = submit(desk, chain())
    assert {desk.state(job.id) for job in again.values()} == {"succeeded"}
    assert work_off(desk) == 0


def test_two_that_are_handed_in_at_once_are_computed_once(desk: Desk) -> None:
    pair = [submit(desk, chain()) for _ in range(2)]
    assert work_off(desk) == 6
    assert {desk.state(job.id) for made in pair for job in made.values()} == {"succeeded"}


@pytest.mark.parametrize(
    ("changes", "pointer", "code"),
    [
        ({"square": {"kind": "sqaure"}}, "/steps/square/kind", "unknown-kind"),
        ({"sum": {"params": {"numbre": 1}}}, "/steps/sum/params/numbre", "extra-forbidden"),
        (
            {"sum": {"kind": "annotate", "params": {"proposal": {"method": "steps", "longest_s": 0.1}}}},
            "/steps/sum/params/proposal",
            "value-error",
        ),
        ({"sum": {"after": ["survey"]}}, "/steps/sum/after/0", "cycle"),
        ({"sum": {"kind": "errand"}}, "/steps/square/inputs/things/step", "wrong-kind"),
        ({"square": {"inputs": {"things": {"step": "none"}}}}, "/steps/square/inputs/things/step", "unknown-step"),
        ({"square": {"inputs": {"things": {"job": "job_x"}}}}, "/steps/square/inputs/things/job", "unknown-job"),
    ],
)
def test_one_bad_step_lets_none_in(desk: Desk, changes: dict[str, Any], pointer: str, code: str) -> None:
    steps = chain()
    for name, change in changes.items():
        steps[name] |= change
    with pytest.raises(InvalidProblem) as refused:
        submit(desk, steps)
    assert [(error.pointer, error.code) for error in refused.value.errors] == [(pointer, code)]
    assert "?." not in refused.value.errors[0].detail  # a question, such as "did you mean 'cut'?", needs no full stop
    assert desk.database.read(desk.user, reading.list_jobs, "lab").items == ()


def test_a_tree_may_wait_for_a_model_that_is_imported(desk: Desk) -> None:
    digest = desk.database.write(desk.user, blobs.put_blob, b"a model of another program")
    files = [{"name": "walk_quaternion_mm.json", "blob": digest}]
    steps = {
        "takes": {"kind": "import", "params": {"files": files}},
        "tree": {"kind": "tree", "inputs": {"model": {"step": "takes"}}},
    }
    assert submit(desk, steps)["tree"].inputs["model"]


def test_a_result_with_one_place_to_go_to_does_not_go_to_the_folder_of_the_pipeline(desk: Desk) -> None:
    digest = desk.database.write(desk.user, blobs.put_blob, b"takes and a model of another program")
    files = [{"name": "walk_quaternion_mm.json", "blob": digest}]
    takes = {"step": "takes"}
    trim = [{"command": "smooth"}]
    steps = {
        "takes": {"kind": "import", "params": {"files": files}},
        "tree": {"kind": "tree", "inputs": {"model": takes}},
        "there": {"kind": "edit", "inputs": {"clips": takes}, "params": {"commands": trim, "in_place": True}},
        "aside": {"kind": "edit", "inputs": {"clips": takes}, "params": {"commands": trim, "suffix": "-smooth"}},
    }
    made = submit(desk, steps, into="game")
    assert {name: job.into for name, job in made.items()} == {"takes": "game", "tree": "", "there": "", "aside": "game"}


def test_a_step_that_asks_for_a_place_its_result_cannot_go_to_is_refused(desk: Desk) -> None:
    digest = desk.database.write(desk.user, blobs.put_blob, b"a model of another program")
    files = [{"name": "walk_quaternion_mm.json", "blob": digest}]
    steps = {
        "takes": {"kind": "import", "params": {"files": files}},
        "tree": {"kind": "tree", "inputs": {"model": {"step": "takes"}}, "into": "trees"},
    }
    with pytest.raises(InvalidProblem) as refused:
        submit(desk, steps)
    assert [(error.pointer, error.code) for error in refused.value.errors] == [("/steps/tree/into", "ambiguous-place")]


def test_what_fails_in_a_pipeline_takes_only_those_along_that_need_it(desk: Desk) -> None:
    steps = chain() | {"aside": {"kind": "sum", "params": {"number": 9}}}
    made = submit(desk, steps)
    desk.fail(desk.claim(job=made["sum"].id), retryable=False)
    assert {name: desk.state(job.id) for name, job in made.items()} == {
        "sum": "failed",
        "square": "failed",
        "survey": "failed",
        "aside": "queued",
    }


def test_results_know_what_they_were_made_from_through_the_whole_pipeline(desk: Desk) -> None:
    made = submit(desk, chain())
    work_off(desk)
    (overview,) = desk.outputs(made["survey"].id)
    first, *_ = desk.outputs(made["sum"].id)
    assert not desk.database.read(desk.user, items.read_staleness, "lab", Kind.CHARACTER, overview.item).stale
    document = {"schema": "marey/document@1", "changed": True}
    desk.database.write(
        desk.user, items.put_part, "lab", Kind.CHARACTER, first.item, "character", document, expected_rev=None
    )
    found = desk.database.read(desk.user, items.read_staleness, "lab", Kind.CHARACTER, overview.item)
    assert found.stale
    assert {edge.item for edge in found.because} == {first.item}
