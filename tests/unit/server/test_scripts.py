"""Scripts in the store: registration, submissions that are checked against the declaration, and lists of runs."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError
from tests.support.queue_desk import Desk

from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.scripts import Script, ScriptCreate, ScriptRunCreate, is_allowed, read_repositories
from marey_server.errors import (
    BadRequestProblem,
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    QuotaExceededProblem,
)
from marey_server.store.jobs import retrying, submission
from marey_server.store.retention import Retention, retire
from marey_server.store.scripts import registry, runs
from marey_server.store.transaction import Quotas

AT = "https://git.invalid/motion"
ALLOWED = ("https://git.invalid/",)
MEASURE: dict[str, Any] = {
    "name": "measure", "repository": AT, "commit": "a" * 40,
    "argv": ["python", "measure.py", "{parameter:size}", "{parameter:mode}", "{output:fields}"],
    "parameters": {
        "size": {"type": "integer", "minimum": 1, "maximum": 9},
        "mode": {"type": "text", "choices": ["fast", "slow"], "default": "fast"},
    },
    "outputs": {"fields": {"kind": "fields"}},
    "limits": {"seconds": 60, "memory_mb": 100},
}  # fmt: skip


def register(desk: Desk, **changes: Any) -> Script:
    request = ScriptCreate.model_validate(MEASURE | changes)
    return desk.database.write(desk.user, registry.register_script, "lab", request, ALLOWED)


def run(desk: Desk, **values: Any) -> str:
    request = ScriptRunCreate(values=values)
    return desk.database.write(desk.user, runs.run_script, "lab", "measure", request).id


def listed(desk: Desk, sort: str) -> list[Any]:
    page = desk.database.read(desk.user, lambda tx: runs.list_runs(tx, "lab", "measure", sort=sort, limit=10))
    return list(page.items)


def finish(desk: Desk, **fields: Any) -> None:
    """Claim the next run, and complete it with these fields."""
    lease = desk.claim(kinds=("script",))
    assert lease.params["declaration"]["commit"] == "a" * 40
    assert (lease.resources.time_limit_s, lease.resources.memory_limit_mb) == (1860, 2148)
    desk.complete(lease, result={"fields": fields})


def test_runs_are_listed_by_their_values_and_logged_fields(desk: Desk) -> None:
    register(desk)
    for size, score in ((2, 0.5), (1, 10), (3, "none"), (4, -1)):
        run(desk, size=size)
        finish(desk, score=score, size=size)
    failing = run(desk, size=9, mode="slow")
    assert [one.values["size"] for one in listed(desk, "-values.size")] == [9, 4, 3, 2, 1]
    scores = [one.fields.get("score") for one in listed(desk, "fields.score")]
    assert [one for one in scores if isinstance(one, int | float)] == [-1, 0.5, 10]
    assert (scores[-1], set(scores)) == (None, {-1, 0.5, 10, "none", None})
    assert listed(desk, "-fields.score")[-1].job == failing
    assert listed(desk, "fields.nothing")[0].job == failing, "newest first"
    first = listed(desk, "created_at")[0]
    assert (first.state, first.values, first.commit) == ("succeeded", {"size": 2, "mode": "fast"}, "a" * 40)
    for sort in ("score", "fields.a'b", "fields.", "id", "values.a.b"):
        with pytest.raises(BadRequestProblem, match="cannot be sorted"):
            listed(desk, sort)


def test_a_result_that_a_worker_made_up_does_not_break_the_list(desk: Desk) -> None:
    register(desk)
    for result in ({"fields": {"a": [1], "b": 2}}, {"fields": [1]}, {"fields": None}, {}):
        run(desk, size=1)
        desk.complete(desk.claim(kinds=("script",)), result=result)
    assert [one.fields for one in listed(desk, "fields.b")] == [{"b": 2}, {}, {}, {}]
    for sort in ("fields.b\n", "created_at\n"):
        with pytest.raises(BadRequestProblem, match="cannot be sorted"):
            listed(desk, sort)


WRONG_VALUES = [
    ({}, "needs the parameter 'size'"),
    ({"size": 0}, "at least 1"),
    ({"size": 10}, "at most 9"),
    ({"size": 1.5}, "an integer"),
    ({"size": True}, "an integer"),
    ({"size": "1"}, "an integer"),
    ({"size": 1, "mode": "other"}, "one of fast, slow"),
    ({"size": 1, "unknown": 1}, "no parameter 'unknown'"),
]


@pytest.mark.parametrize(("values", "reason"), WRONG_VALUES)
def test_wrong_values_are_refused_at_submission(desk: Desk, values: dict[str, Any], reason: str) -> None:
    register(desk)
    with pytest.raises(InvalidProblem, match=reason) as refused:
        run(desk, **values)
    assert refused.value.errors[0].pointer.startswith("/params/values/")
    assert listed(desk, "created_at") == []


def test_a_run_is_committed_as_its_request_says(desk: Desk) -> None:
    outputs = {"copy": {"kind": "clip", "format": "bvh"}, "fields": {"kind": "fields"}}
    register(desk, argv=[*MEASURE["argv"], "{output:copy}"], outputs=outputs)
    request = ScriptRunCreate(values={"size": 2}, into="made", commit=OutputsCommit(dataset="gaits"))
    with pytest.raises(InvalidProblem) as refused:
        desk.database.write(desk.user, runs.run_script, "lab", "measure", request)
    assert [one.pointer for one in refused.value.errors] == ["/commit/dataset"]


def test_a_job_may_not_bring_its_own_declaration(desk: Desk) -> None:
    made = register(desk)
    other = made.declaration.model_copy(update={"argv": ("python", "evil.py", *made.declaration.argv[2:])})
    for declaration, wrong in ((other, True), (made.declaration, False)):
        params = {"script": "measure", "values": {"size": 1}, "declaration": declaration.model_dump(mode="json")}
        request = JobCreate(kind="script", params=params)
        if wrong:
            with pytest.raises(InvalidProblem, match="another declaration"):
                desk.database.write(desk.user, submission.submit, "lab", (request,))
        else:
            desk.database.write(desk.user, submission.submit, "lab", (request,))
    request = JobCreate(kind="script", params={"script": "unknown"})
    with pytest.raises(InvalidProblem, match="no script 'unknown'"):
        desk.database.write(desk.user, submission.submit, "lab", (request,))


def test_a_run_is_retried_only_while_its_script_is_registered(desk: Desk) -> None:
    register(desk)
    job = run(desk, size=1)
    lease = desk.claim(kinds=("script",))
    desk.fail(lease, retryable=False)
    again = desk.database.write(desk.user, retrying.retry_job, job)
    assert [one.job for one in listed(desk, "-created_at")] == [again.id, job]
    desk.database.write(desk.user, registry.delete_script, "lab", "measure")
    assert len(listed(desk, "created_at")) == 2, "the runs stay"
    with pytest.raises(ConflictProblem, match="no script 'measure'"):
        desk.database.write(desk.user, retrying.retry_job, job)
    register(desk, commit="b" * 40)
    with pytest.raises(ConflictProblem, match="another declaration"):
        desk.database.write(desk.user, retrying.retry_job, job)


def test_scripts_are_off_unless_the_server_allows_their_repository(desk: Desk) -> None:
    request = ScriptCreate.model_validate(MEASURE)
    with pytest.raises(ForbiddenProblem, match="runs no scripts"):
        desk.database.write(desk.user, registry.register_script, "lab", request, ())
    for allowed in (("https://git.invalid",), ("https://git.invalid/mot",), ("https://other.invalid/",)):
        with pytest.raises(InvalidProblem, match="does not allow the repository"):
            desk.database.write(desk.user, registry.register_script, "lab", request, allowed)
    register(desk)
    with pytest.raises(ConflictProblem, match="'measure' already"):
        register(desk)
    desk.database.quotas = Quotas(project_scripts=1)
    with pytest.raises(QuotaExceededProblem, match="project_scripts"):
        register(desk, name="other")
    with pytest.raises(NotFoundProblem):
        desk.database.read(desk.user, registry.read_script, "lab", "other")


WRONG_DECLARATIONS = [
    ({"commit": "a" * 39}, "commit"),
    ({"commit": "main"}, "commit"),
    ({"repository": "https://user:secret@git.invalid/x"}, "repository"),
    ({"repository": "ext::sh -c evil"}, "repository"),
    ({"repository": "https://git.invalid/a/../b"}, "folders"),
    ({"repository": "https://git.invalid/-x y"}, "repository"),
    ({"argv": ["sh", "-c", "evil"]}, "first word"),
    ({"argv": ["python", "-c", "evil"]}, "not the path"),
    ({"argv": ["python", "../evil.py"]}, "not the path"),
    ({"argv": ["./../evil"]}, "not the path"),
    ({"argv": ["python"]}, "not the path"),
    ({"argv": ["python", "a.py\n"]}, "not the path"),
    ({"argv": ["python", "a.py", "{output:fields}\n"]}, "word of its own"),
    ({"parameters": {"size": {"type": "text", "choices": ["a\0b"]}}}, "NUL character"),
    ({"parameters": {"size": {"minimum": 5, "maximum": 1}}}, "greater than"),
    ({"argv": ["python", "a.py", "--size={parameter:size}"]}, "word of its own"),
    ({"argv": ["python", "a.py", "{input:clip}"]}, "not declared"),
    ({"argv": ["python", "a.py"]}, "no word is"),
    ({"outputs": {}}, "outputs"),
    ({"outputs": {"fields": {"kind": "clip"}}}, "formats bvh"),
    ({"parameters": {"size": {"type": "text", "minimum": 1}}}, "minimum"),
    ({"parameters": {"size": {"minimum": 1, "default": 0}}}, "default"),
    ({"inputs": {"clip": {"kind": "model", "format": "bvh"}}}, "only as json"),
    ({"limits": {"seconds": 10**6}}, "seconds"),
    ({"image": "x"}, "image"),
]


@pytest.mark.parametrize(("changes", "reason"), WRONG_DECLARATIONS)
def test_wrong_declarations_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        ScriptCreate.model_validate(MEASURE | changes)


def test_texts_cannot_become_options(desk: Desk) -> None:
    parameters = {"size": {"type": "text"}, "mode": {"type": "text", "default": "x"}}
    register(desk, parameters=parameters)
    for size in ("--evil", "a\nb", "x" * 501):
        with pytest.raises(InvalidProblem):
            run(desk, size=size)
    run(desk, size="a b; $(c)")


def test_old_runs_are_deleted_with_their_jobs(desk: Desk) -> None:
    register(desk)
    run(desk, size=1)
    finish(desk, score=1)
    desk.clock.advance(400 * 86400)
    retire(desk.database, Retention(jobs_days=100))
    assert listed(desk, "created_at") == []


def test_the_variable_is_a_json_list() -> None:
    assert read_repositories({}) == ()
    assert read_repositories({"MAREY_SCRIPT_REPOSITORIES": '["https://a/", "file:///b"]'}) == (
        "https://a/",
        "file:///b",
    )
    for text in ("https://a/", "[1]", "{}"):
        with pytest.raises(ValueError, match="JSON list"):
            read_repositories({"MAREY_SCRIPT_REPOSITORIES": text})
    assert is_allowed("file:///b", ["file:///b"])
    assert not is_allowed("file:///b/c", ["file:///b"])
