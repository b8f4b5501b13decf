"""Pipelines become jobs: all of them in one transaction, or none."""

from __future__ import annotations

from marey_schemas.access import Role
from marey_schemas.pipelines import Pipeline, PipelineCreate, PipelineError, job_of_step, order_steps
from marey_schemas.problems import FieldError
from marey_server.errors import Invalid
from marey_server.store.ids import new_id
from marey_server.store.projects import require
from marey_server.store.submission import submit_at
from marey_server.store.transaction import Transaction


def submit_pipeline(tx: Transaction, project: str, pipeline: PipelineCreate) -> Pipeline:
    """Submit a job for each step. Those that work on what others make get their inputs when these have succeeded.

    Raises `Invalid` with a pointer for each thing that makes no sense, and what `require` raises.
    """
    row = require(tx, project, Role.CONTRIBUTOR, "jobs")
    try:
        order = order_steps(pipeline)
    except PipelineError as error:
        detail = str(error)
        raise Invalid(detail, errors=[FieldError(pointer=error.pointer, code=error.code, detail=detail)]) from error
    ids = {name: new_id("job") for name in order}
    places = {name: f"/steps/{name}" for name in order}
    requests = {places[name]: job_of_step(pipeline, name, ids) for name in order}
    jobs = submit_at(tx, row, requests, {places[name]: ids[name] for name in order})
    return Pipeline(jobs=dict(zip(order, jobs, strict=True)))
