"""Pipelines become jobs: all of them in one transaction, or none."""

from __future__ import annotations

from pydantic import ValidationError

from marey_schemas.job_kinds import UnknownKindError, find_kind
from marey_schemas.jobs import JobCreate
from marey_schemas.pipelines import Pipeline, PipelineCreate, PipelineError, PipelineStep, job_of_step, order_steps
from marey_schemas.problems import FieldError
from marey_server.errors import Invalid
from marey_server.store.ids import new_id
from marey_server.store.jobs.submission import submit_at
from marey_server.store.projects import require
from marey_server.store.transaction import Transaction


def submit_pipeline(tx: Transaction, project: str, pipeline: PipelineCreate) -> Pipeline:
    """Submit a job for each step. Those that work on what others make get their inputs when these have succeeded.

    Raises `Invalid` with a pointer for each thing that makes no sense, and what `require` raises.
    """
    row = require(tx, project)
    try:
        order = order_steps(pipeline)
    except PipelineError as error:
        detail = str(error)
        raise Invalid(detail, errors=[FieldError(pointer=error.pointer, code=error.code, detail=detail)]) from error
    ids = {name: new_id("job") for name in order}
    places = {name: f"/steps/{name}" for name in order}
    requests = {places[name]: _placed(job_of_step(pipeline, name, ids), pipeline.steps[name]) for name in order}
    jobs = submit_at(tx, row, requests, {places[name]: ids[name] for name in order})
    return Pipeline(jobs=dict(zip(order, jobs, strict=True)))


def _placed(request: JobCreate, step: PipelineStep) -> JobCreate:
    """The job of a step whose results have one place to go to, as a tree's, without the collection that the pipeline
    has for all.
    """
    if step.into is not None:
        return request
    try:
        kind = find_kind(request.kind)
        params = kind.params.model_validate(request.params)
    except (UnknownKindError, ValidationError):
        return request  # it is refused where it is checked, with the place of what is wrong
    unclear = kind.unclear_place
    if unclear is None or unclear(params, request.into) is None or unclear(params, "") is not None:
        return request
    return request.model_copy(update={"into": ""})
