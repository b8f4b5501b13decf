"""Reading of the runs of a script for a comparison: their settings, numbers, and the curves of logged fields."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from datetime import datetime
from itertools import islice
from typing import Any, NamedTuple

from pydantic import ValidationError
from sqlalchemy import Row, select

from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.names import is_digest
from marey_schemas.queue.comparisons import MOST_COMPARED, MOST_CURVE_BYTES, Curve, Curves
from marey_schemas.queue.scripts import LONGEST_NAME, LONGEST_TEXT, MOST_FIELDS, Value
from marey_schemas.wording import counted
from marey_server.store import blobs, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.scripts.runs import fields_of, order_of_runs, sound_values
from marey_server.store.tables import job, script_run
from marey_server.store.transaction import Transaction

_ROWS_AT_ONCE = 10
"""Number of rows that are read at once, because the inputs of a job may take megabytes."""


class RunToCompare(NamedTuple):
    """Succeeded run of a script; `setting` is equal for all runs that differ only in their seeds."""

    job: str
    commit: str
    seed: int
    created_at: datetime
    setting: str
    inputs: dict[str, str]
    values: dict[str, Value]
    fields: dict[str, Value]
    curves_blob: str | None


def find_runs(
    tx: Transaction, project: str, name: str, *, sort: str, limit: int = MOST_COMPARED
) -> tuple[list[RunToCompare], bool]:
    """Return the first `limit` succeeded runs of a script in the given order, and whether these are all of them.

    Raises `BadRequestProblem` for an unknown order.
    """
    row = projects.require(tx, project)
    statement = (
        select(job.c.id, job.c.params, job.c.inputs, job.c.result, job.c.seed, job.c.created_us)
        .select_from(script_run.join(job, job.c.id == script_run.c.job_id))
        .where(script_run.c.project_id == row.id, script_run.c.script == name, job.c.state == "succeeded")
        .order_by(*order_of_runs(tx, sort), job.c.id.desc())
        .limit(limit + 1)
        .execution_options(yield_per=_ROWS_AT_ONCE)
    )
    found = [_run_of(one) for one in tx.execute(statement)]
    return found[:limit], len(found) <= limit


def read_curves(tx: Transaction, digests: Iterable[str]) -> dict[str, dict[str, Curve]]:
    """Return the curves in blobs, by the digest of the blob.

    Blobs that are missing, too large, or contain no curves are left out: a worker can name any blob of the project in
    the result of a job.
    """
    readable = blobs.sizes_of(tx, blobs.readable(tx, set(digests)))
    small = {digest: size for digest, size in readable.items() if size <= MOST_CURVE_BYTES}
    tx.blobs.expect(tx.connection, list(small))
    found = {}
    for digest, size in small.items():
        try:
            found[digest] = Curves.model_validate_json(blobs.read_blob(tx, digest, 0, size)).curves
        except ValidationError:
            continue  # it is another file
    return found


def _run_of(row: Row[Any]) -> RunToCompare:
    declared, values = row.params["declaration"], row.params["values"]
    pins = {name: [(pin["item"], pin["revision"]) for pin in _listed(given)] for name, given in row.inputs.items()}
    command = {key: declared[key] for key in ("repository", "commit", "argv")}
    text = canonical_json({"command": command, "values": values, "inputs": pins})
    stored = row.result.get("curves") if isinstance(row.result, dict) else None
    blob = stored.get("blob") if isinstance(stored, dict) else None
    return RunToCompare(
        job=row.id,
        commit=declared["commit"],
        seed=row.seed,
        created_at=datetime_of(row.created_us),
        setting=hashlib.sha256(text).hexdigest(),
        inputs={name: _words_of(_listed(given)) for name, given in row.inputs.items()},
        values=sound_values(values),
        fields=dict(islice(filter(_is_short, fields_of(row.result).items()), MOST_FIELDS)),
        curves_blob=blob if isinstance(blob, str) and is_digest(blob) else None,
    )


def _listed(given: Any) -> list[Mapping[str, Any]]:
    return given if isinstance(given, list) else [given]


def _words_of(pins: list[Mapping[str, Any]]) -> str:
    """Return a short text for an input: path and revision of a single item, or the number of items and their hash."""
    if len(pins) != 1:
        revisions = canonical_json([(pin["item"], pin["revision"]) for pin in pins])
        return f"{counted(len(pins), 'item')} #{hashlib.sha256(revisions).hexdigest()[:6]}"
    (pin,) = pins
    path = "/".join(filter(None, (pin.get("collection"), pin.get("name"))))
    return f"{path or pin['item']}@{pin['revision']}"


def _is_short(field: tuple[str, Value]) -> bool:
    """Return whether the name and the text of a logged field are short enough; workers can write any JSON."""
    name, value = field
    return len(name) <= LONGEST_NAME and not (isinstance(value, str) and len(value) > LONGEST_TEXT)
