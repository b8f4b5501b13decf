"""Registered scripts: maintainers register and delete them, and submissions of jobs are checked against them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Row, Select, delete, insert, select

from marey_schemas.items import Page
from marey_schemas.problems import FieldError
from marey_schemas.queue.scripts import SCRIPT, Script, ScriptCreate, ScriptDeclaration, ScriptParams, is_allowed
from marey_server.access.own_pods import require_allowed_image
from marey_server.errors import ConflictProblem, ForbiddenProblem, InvalidProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.quotas import counting
from marey_server.store.tables import script, script_run, user
from marey_server.store.transaction import Transaction


def list_scripts(tx: Transaction, project: str, *, cursor: str | None, limit: int) -> Page:
    """List the scripts of a project by name."""
    row = projects.require(tx, project)
    order = listing.parse_order("name", {"name": script.c.name, "id": script.c.id})
    rows, following = listing.read_page(tx, _rows(row), order, ["scripts", row.id], cursor, limit)
    return Page(items=tuple(_shown(project, one) for one in rows), next_cursor=following)


def read_script(tx: Transaction, project: str, name: str) -> Script:
    """Return a script. Raises `NotFoundProblem` if it does not exist."""
    return _shown(project, find_script(tx, projects.require(tx, project), name))


def register_script(tx: Transaction, project: str, request: ScriptCreate, allowed: Sequence[str]) -> Script:
    """Register a script. `allowed` are the repositories that the server allows.

    Raises `ForbiddenProblem` if no scripts are allowed, `InvalidProblem` if the repository or the image is not allowed,
    `ConflictProblem` if the name is taken, and `QuotaExceededProblem` if the project has too many scripts.
    """
    row = projects.require(tx, project)
    if not allowed:
        raise ForbiddenProblem(
            "This server runs no scripts; its operator can allow repositories with the setting `script_repositories`.",
            code="scripts-off",
        )
    if not is_allowed(request.repository, allowed):
        detail = "This server does not allow the repository; ask its operator to add it to `script_repositories`."
        raise _invalid("/repository", "repository-not-allowed", detail)
    if request.image is not None:
        require_allowed_image(request.image, tx.pod_rules, "/image")
    counting.require_place(tx, row.id, script)
    values: dict[str, Any] = {
        "id": new_id(SCRIPT), "project_id": row.id, "name": request.name, "description": request.description,
        "declaration": request.declaration.model_dump(mode="json"), "author_id": tx.principal.user_id,
        "created_us": tx.now_us,
    }  # fmt: skip
    made = tx.execute(tx.insert_or_ignore(script, values).returning(script.c.id)).first()
    if made is None:
        raise ConflictProblem(
            f"The project has a script {request.name!r} already; delete it first, or choose another name.",
            code="script-exists",
        )
    tx.audit("script.registered", values["id"], about=request.name, project_id=row.id, commit=request.commit)
    return _shown(project, find_script(tx, row, request.name))


def delete_script(tx: Transaction, project: str, name: str) -> None:
    """Delete a script; its runs stay, but cannot be retried."""
    row = projects.require(tx, project)
    found = find_script(tx, row, name)
    tx.execute(delete(script).where(script.c.id == found.id))
    tx.audit("script.deleted", found.id, about=name, project_id=row.id)


# -- submissions ------------------------------------------------------------------------------------------------------


def resolve_params(tx: Transaction, project: ProjectRow, params: ScriptParams, at: str) -> ScriptParams:
    """Return the parameters of a job with the registered declaration of its script, and with default values.

    `at` is the JSON Pointer to the job in the request. Raises `InvalidProblem` with a pointer to each fault: an unknown
    script, another declaration than the registered one, or a missing or wrong value.
    """
    try:
        found = find_script(tx, project, params.script)
    except NotFoundProblem as error:
        raise _invalid(f"{at}/params/script", "no-script", error.detail) from error
    declared = ScriptDeclaration.model_validate(found.declaration)
    if params.declaration not in (None, declared):
        detail = f"The script {params.script!r} has another declaration now; omit `declaration` to use the new one."
        raise _invalid(f"{at}/params/declaration", "script-changed", detail)
    faults = [
        FieldError(pointer=f"{at}/params/values/{name}", code="bad-value", detail=f"{fault[0].upper()}{fault[1:]}.")
        for name, fault in declared.faults_of(params.values)
    ]
    if faults:
        detail = f"The values are not valid: {faults[0].pointer}: {faults[0].detail}"
        unnamed = "The values are not valid for the parameters of the script."
        raise InvalidProblem(detail, errors=faults, unnamed=unnamed)
    return params.model_copy(update={"declaration": declared, "values": declared.values_of(params.values)})


def require_unchanged(tx: Transaction, project: ProjectRow, params: Mapping[str, Any]) -> None:
    """Raise `ConflictProblem` if the script of an earlier job was deleted, or registered again in another form."""
    earlier = ScriptParams.model_validate(params)
    try:
        resolve_params(tx, project, earlier, "")
    except InvalidProblem as error:
        raise ConflictProblem(f"The job cannot run again: {error.detail}", code="script-changed") from error


def record_runs(tx: Transaction, project_id: str, jobs: Iterable[tuple[str, str, Mapping[str, Any]]]) -> None:
    """Record which of the new jobs, given by id, kind and parameters, are runs of scripts."""
    rows = [
        {"job_id": job_id, "project_id": project_id, "script": params["script"]}
        for job_id, kind, params in jobs
        if kind == SCRIPT
    ]
    if rows:
        tx.execute(insert(script_run), rows)


# -- rows -------------------------------------------------------------------------------------------------------------


def find_script(tx: Transaction, row: ProjectRow, name: str) -> Row[Any]:
    """Return the row of a script. Raises `NotFoundProblem` if it does not exist."""
    found = tx.execute(_rows(row).where(script.c.name == name)).first()
    if found is None:
        raise NotFoundProblem(f"The project has no script {name!r}.", code="no-script")
    return found


def _rows(row: ProjectRow) -> Select[*tuple[Any, ...]]:
    return (
        select(*script.c, user.c.name.label("author"))
        .select_from(script.outerjoin(user, user.c.id == script.c.author_id))
        .where(script.c.project_id == row.id)
    )


def _shown(project: str, row: Row[Any]) -> Script:
    return Script(
        name=row.name,
        project=project,
        description=row.description,
        declaration=ScriptDeclaration.model_validate(row.declaration),
        author=row.author,
        created_at=datetime_of(row.created_us),
    )


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, errors=[FieldError(pointer=pointer, code=code, detail=detail)])
