"""Runs of scripts: their submission, and lists that are sorted by the fields that the runs logged."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from sqlalchemy import ColumnElement, Row, func, select

from marey_schemas.items import Page
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.queue.scripts import SCRIPT, ScriptRun, ScriptRunCreate, Value
from marey_server.errors import BadRequestProblem
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.jobs.submission import submit
from marey_server.store.scripts.registry import find_script
from marey_server.store.tables import job, script_run, user
from marey_server.store.transaction import Transaction

_SORT = re.compile(r"(-?)(created_at|(?:(fields|values)\.([A-Za-z][A-Za-z0-9_]{0,62})))")


def run_script(tx: Transaction, project: str, name: str, request: ScriptRunCreate) -> Job:
    """Submit a job that runs a script, and return the job.

    Raises `NotFoundProblem` if there is no such script, and the errors of `submission.submit`.
    """
    find_script(tx, projects.require(tx, project), name)
    params = request.model_dump(mode="json", include={"values", "allow_expired_consent", "consent_reason"})
    wanted = JobCreate(
        kind=SCRIPT,
        inputs=request.inputs,
        params={"script": name, **params},
        into=request.into,
        seed=request.seed,
        message=request.message,
        commit=request.commit,
    )
    (made,) = submit(tx, project, (wanted,))
    return made


def list_runs(tx: Transaction, project: str, name: str, *, sort: str, limit: int) -> Page:
    """Return the first `limit` runs of a script in the given order; runs without the field of the order come last.

    The list also contains runs of an earlier script with the same name. Raises `BadRequestProblem` for another order
    than `created_at`, `fields.<name>` or `values.<name>`, with or without a leading `-`.
    """
    row = projects.require(tx, project)
    statement = (
        select(job, user.c.name.label("author"))
        .select_from(
            script_run.join(job, job.c.id == script_run.c.job_id).outerjoin(user, user.c.id == job.c.author_id)
        )
        .where(script_run.c.project_id == row.id, script_run.c.script == name)
        .order_by(*order_of_runs(tx, sort), job.c.id.desc())
        .limit(limit)
    )
    return Page(items=tuple(map(_shown, tx.execute(statement))))


def order_of_runs(tx: Transaction, sort: str) -> list[ColumnElement[Any]]:
    """Return the columns by which a list of runs is sorted. Raises `BadRequestProblem` for an unknown order."""
    match = _SORT.fullmatch(sort)
    if match is None:
        raise BadRequestProblem(
            f"The runs cannot be sorted by {sort!r}; sort them by created_at, fields.<name> or values.<name>.",
            code="bad-sort",
        )
    falls, key, group, field = match.groups()
    if key == "created_at":
        return [job.c.created_us.desc() if falls else job.c.created_us.asc()]
    document = job.c.result if group == "fields" else job.c.params
    if tx.is_postgres:
        value: ColumnElement[Any] = func.jsonb_extract_path(document, group, field)
    else:
        value = func.json_extract(document, f"$.{group}.{field}")
    return [(value.desc() if falls else value.asc()).nulls_last()]


def _shown(row: Row[Any]) -> ScriptRun:
    return ScriptRun(
        job=row.id,
        state=row.state,
        values=row.params["values"],
        fields=fields_of(row.result),
        commit=row.params["declaration"]["commit"],
        seed=row.seed,
        author=row.author,
        created_at=datetime_of(row.created_us),
        finished_at=None if row.finished_us is None else datetime_of(row.finished_us),
    )


def fields_of(result: Any) -> dict[str, Value]:
    """Return the logged fields in the result of a run.

    A worker can write any JSON into a result; values that are no logged fields are left out.
    """
    fields = result.get("fields") if isinstance(result, dict) else None
    return sound_values(fields) if isinstance(fields, dict) else {}


def sound_values(values: Mapping[str, Any]) -> dict[str, Value]:
    """Return those of the values that are texts, truth values or finite numbers, by name.

    An integer of more than 64 bits becomes a float, because Postgres returns a large float such as 1e20 as an integer.
    """
    found: dict[str, Value] = {}
    for name, value in values.items():
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            with suppress(OverflowError):
                found[name] = float(value)
        elif isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
            found[name] = value
    return found
