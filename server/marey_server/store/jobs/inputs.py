"""Resolves the inputs of a submission to exact revisions, and records the items that jobs name."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, bindparam, func, insert, or_, select

from marey_schemas.kinds import Kind
from marey_schemas.problems import FieldError
from marey_schemas.queue.jobs import (
    CollectionInput,
    DatasetInput,
    InputSpec,
    ItemInput,
    JobCreate,
    JobInput,
    JobOutputsInput,
)
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.wording import counted
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.store import datasets
from marey_server.store.database.prepared import Prepared
from marey_server.store.ids import ids_in
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, item, job_item
from marey_server.store.transaction import Transaction, in_lists

MOST_INPUTS = 100_000

Pin = dict[str, Any]
"""Input as a job stores it: an exact revision of an item, with the fields of `PinnedInput`.

An input that does not exist yet is stored with the single field `job`: the id of the job that will create the input.
"""

PinnedInputs = dict[str, list[Pin]]


class FoundItem(NamedTuple):
    """Item at its newest revision."""

    id: str
    kind: str
    name: str
    head: int
    path: str


_ITEMS = (
    select(item.c.id, item.c.kind, item.c.name, item.c.head, collection.c.path)
    .join(collection, collection.c.id == item.c.collection_id)
    .where(item.c.project_id == bindparam("project_id"), item.c.deleted_us.is_(None))
)
_ITEMS_BY_ID = Prepared(_ITEMS.where(item.c.id.in_(bindparam("ids", expanding=True))))


def find_items(tx: Transaction, project: ProjectRow, requests: Iterable[JobCreate]) -> dict[str, FoundItem]:
    """Return, by id, the items that the requests name by their ids, not through a collection or a dataset."""
    choices = (choice for request in requests for many in request.inputs.values() for choice in _as_many(many))
    return items_by_id(tx, project.id, (choice.item for choice in choices if isinstance(choice, ItemInput)))


def items_by_id(tx: Transaction, project_id: str, ids: Iterable[str]) -> dict[str, FoundItem]:
    """Return the items of the project that have the given ids, by id."""
    wanted = sorted(set(ids))
    rows = [
        FoundItem(row.id, row.kind, row.name, row.head, row.path)
        for some in in_lists(wanted)
        for row in tx.run(_ITEMS_BY_ID, {"project_id": project_id, "ids": some})
    ]
    return {row.id: row for row in rows}


def pin_inputs(
    tx: Transaction,
    project: ProjectRow,
    kind: KindDeclaration,
    request: JobCreate,
    known: dict[str, FoundItem],
    at: str = "",
) -> PinnedInputs:
    """Determine the exact revision of every input: the named revision, or else the newest one.

    Collections are replaced by their items. Inputs that are outputs of other jobs are determined later (`late_inputs`).
    `known` contains the items that `find_items` returned for the request.

    Raises `InvalidProblem`, which lists all faults with pointers below `at`. Faults are an input that the kind does not
    have, a required input without a value, and an empty collection. Other faults are an item or revision that is not in
    the project, and an item of another kind.
    """
    errors = _misnamed(kind, request, at)
    pins: PinnedInputs = {}
    for name, choices in request.inputs.items():
        spec = kind.inputs.get(name)
        if spec is not None:
            pins[name] = _pin_input(tx, project, spec, choices, f"{at}/inputs/{_escaped(name)}", known, errors)
    if not errors:
        errors += _missing_revisions(request, known, at)
    total = sum(map(len, pins.values()))
    if total > MOST_INPUTS:
        errors.append(
            _error(f"{at}/inputs", "too-many", f"The job has {total} inputs; at most {MOST_INPUTS} are allowed.")
        )
    if errors:
        first = f"{errors[0].pointer}: {errors[0].detail}"
        raise InvalidProblem(
            f"The inputs of the job are not valid: {first}",
            errors=errors[:100],
            unnamed="The inputs of the job are not valid: they are missing, of another kind, or cannot be read.",
        )
    return pins


def _misnamed(kind: KindDeclaration, request: JobCreate, at: str) -> list[FieldError]:
    unknown = [
        _error(
            f"{at}/inputs/{_escaped(name)}",
            "unknown-input",
            f"Jobs of the kind {kind.name} have no input {name!r}; their inputs are "
            f"{', '.join(map(repr, kind.inputs)) or 'none'}.",
        )
        for name in request.inputs
        if name not in kind.inputs
    ]
    lacking = [
        _error(
            f"{at}/inputs",
            "missing-input",
            f"Jobs of the kind {kind.name} need the input {name!r}"
            + (f": {spec.description}" if spec.description else "."),
        )
        for name, spec in kind.inputs.items()
        if spec.required and name not in request.inputs
    ]
    return unknown + lacking


def _pin_input(
    tx: Transaction,
    project: ProjectRow,
    spec: InputSpec,
    choices: Any,
    pointer: str,
    known: dict[str, FoundItem],
    errors: list[FieldError],
) -> list[Pin]:
    single = not isinstance(choices, tuple)
    if spec.required and not _as_many(choices):
        errors.append(_error(pointer, "empty-input", f"This input needs at least one {spec.kind.noun}."))
    pins: dict[tuple[str, int], Pin] = {}
    made: dict[str, Pin] = {}
    for index, choice in enumerate(_as_many(choices)):
        place = pointer if single else f"{pointer}/{index}"
        if isinstance(choice, JobOutputsInput):
            made[choice.job] = {"job": choice.job}
            continue
        if isinstance(choice, DatasetInput):
            for entry in _entries_of(tx, project, spec, choice, place, errors):
                pins.setdefault((entry["item"], entry["revision"]), entry)
            continue
        if isinstance(choice, CollectionInput):
            found = _items_below(tx, project, spec, choice.collection)
            if not found:
                hint = "; align its clips first" if spec.kind is Kind.PROCESSED else ""
                detail = f"The collection {choice.collection!r} contains no {spec.kind.noun}{hint}."
                errors.append(_error(f"{place}/collection", "empty-collection", detail))
            chosen = [(one, one.head) for one in found]
        else:
            one = known.get(choice.item)
            if one is None or one.kind != spec.kind:
                detail = f"There is no {spec.kind.value} {choice.item!r} in the project."
                errors.append(_error(f"{place}/item", "unknown-item", detail))
                continue
            chosen = [(one, choice.revision or one.head)]
        for one, number in chosen:
            pins.setdefault((one.id, number), pin(one, number))
    total = len(pins) + len(made)
    if not errors and not spec.many and total != 1:
        errors.append(_error(pointer, "one-item", f"This input takes one {spec.kind.value}, not {total}."))
    return [*pins.values(), *made.values()]


def late_inputs(request: JobCreate, at: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield the inputs that other jobs produce.

    Each value contains the JSON Pointer to the input in the request, the name of the input, and the id of the job.
    """
    for name, choices in request.inputs.items():
        for index, choice in enumerate(_as_many(choices)):
            if isinstance(choice, JobOutputsInput):
                place = f"{at}/inputs/{_escaped(name)}" + (f"/{index}" if isinstance(choices, tuple) else "")
                yield place, name, choice.job


def pin(found: FoundItem, number: int) -> Pin:
    """Return an item and its revision in the form that the job stores."""
    return {"item": found.id, "revision": number, "kind": found.kind, "name": found.name, "collection": found.path}


# -- looking up -------------------------------------------------------------------------------------------------------


def _items_below(tx: Transaction, project: ProjectRow, spec: InputSpec, path: str) -> list[FoundItem]:
    """Return the items of the input's kind in a collection and below it, ordered by path and name."""
    statement = _ITEMS.where(item.c.kind == spec.kind.value).limit(MOST_INPUTS + 1)
    if path:
        statement = statement.where(_within(path))
    rows = tx.execute(statement.order_by(collection.c.path, item.c.name, item.c.id), {"project_id": project.id})
    return [FoundItem(row.id, row.kind, row.name, row.head, row.path) for row in rows]


def _entries_of(
    tx: Transaction, project: ProjectRow, spec: InputSpec, choice: DatasetInput, place: str, errors: list[FieldError]
) -> Iterator[Pin]:
    """Yield an exact revision (`Pin`) for each entry of the dataset version that `choice` names.

    The pin has the name and the folder of the entry in this version, not those of the item. Faults are added to
    `errors`; `place` is the JSON Pointer to `choice` in the request.
    """
    try:
        version = datasets.entries_of_kind(
            tx, project, choice.dataset, choice.version, spec.kind, path=choice.path, most=MOST_INPUTS + 1
        )
    except (NotFoundProblem, InvalidProblem) as error:
        errors.append(_error(place, error.error_code, error.detail))
        return
    if version.missing:
        detail = (
            f"The project has no item with the content of {counted(len(version.missing), 'entry')} of the version; the "
            f"first is at {version.missing[0].path!r}. Select other entries, or another version."
        )
        errors.append(_error(place, "no-content", detail))
    elif not version.found:
        detail = f"The version has no {spec.kind.value} at {choice.path!r} or below it."
        errors.append(_error(f"{place}/path", "empty-version", detail))
    for one in version.found:
        folder, _, name = f"{version.folder}/{one.entry.path}".strip("/").rpartition("/")
        yield {
            "item": one.item, "revision": one.number, "kind": spec.kind.value, "name": name, "collection": folder,
            "commit": version.commit,
        }  # fmt: skip


def _within(path: str) -> ColumnElement[bool]:
    """Return the SQL condition that a path is `path` or below it.

    The paths are compared as texts, because LIKE would ignore case on SQLite.
    """
    below = f"{path}/"
    return or_(collection.c.path == path, func.substr(collection.c.path, 1, len(below)) == below)


def _missing_revisions(request: JobCreate, known: dict[str, FoundItem], at: str) -> list[FieldError]:
    """Return an error for each input of the request that names a revision which does not exist."""
    asked: list[tuple[str, ItemInput]] = []
    for name, choices in request.inputs.items():
        for index, choice in enumerate(_as_many(choices)):
            if isinstance(choice, ItemInput) and choice.revision is not None:
                place = f"{at}/inputs/{_escaped(name)}" + (f"/{index}" if isinstance(choices, tuple) else "")
                asked.append((place, choice))
    beyond = [(place, choice) for place, choice in asked if (choice.revision or 0) > known[choice.item].head]
    return [
        _error(f"{place}/revision", "unknown-revision", f"{choice.item} has no revision {choice.revision}.")
        for place, choice in beyond
    ]


def _as_many(choices: Any) -> Sequence[JobInput]:
    return choices if isinstance(choices, tuple) else (choices,)


def _escaped(name: str) -> str:
    return name.replace("~", "~0").replace("/", "~1")


def _error(pointer: str, code: str, detail: str) -> FieldError:
    return FieldError(pointer=pointer, code=code, detail=detail)


# -- items that jobs name ---------------------------------------------------------------------------------------------

_KINDS = frozenset(kind.value for kind in Kind)


class NamingJob(NamedTuple):
    """Job with those columns of its row that can name items: inputs, parameters and outputs."""

    id: str
    inputs: Mapping[str, Any] = {}
    params: Mapping[str, Any] = {}
    """Parameters of the job; empty for a task, because the parent job has the same parameters."""
    outputs: Sequence[Mapping[str, Any]] = ()

    def items(self) -> set[str]:
        """Return the ids of the items that the job names.

        Two kinds of inputs are left out: an input that was split among tasks, because the tasks name its items, and
        inputs that other jobs have not produced yet.
        """
        found = {one["item"] for one in self.outputs}
        for pins in self.inputs.values():
            if isinstance(pins, list):
                found.update(pin["item"] for pin in pins if "item" in pin)
        if self.params:
            found.update(one for one in ids_in(json.dumps(self.params)) if one.partition("_")[0] in _KINDS)
        return found


_INSERT = Prepared(insert(job_item))


def record_named_items(tx: Transaction, jobs: Iterable[NamingJob], *, new: bool = False) -> None:
    """Record the items that jobs name, so that a purge finds these jobs by an index; earlier records are kept.

    Every write that stores inputs, parameters or outputs in the row of a job must call this. `new` says that the same
    write has inserted the jobs, so that they have no earlier records.
    """
    rows = ({"job_id": one.id, "item_id": item} for one in jobs for item in sorted(one.items()))
    for some in in_lists(rows):  # the tasks of one job can have millions of rows
        if new:
            tx.run_each(_INSERT, some)
        else:
            tx.execute(tx.insert_or_ignore(job_item), some)
