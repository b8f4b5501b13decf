"""Limits of one project or user: administrators set them; members of the project, or the user, can read them."""

from __future__ import annotations

from sqlalchemy import update

from marey_schemas.access import ProjectQuotaChange, ProjectQuotasInUse, QuotaChange, QuotasInUse, RunningJobs
from marey_server.store.quotas.holdings import change_limits, show_quotas
from marey_server.store.quotas.running_jobs import read_limit, set_limit
from marey_server.store.tables import project
from marey_server.store.transaction import Transaction


def show_project_quotas(tx: Transaction, project_id: str) -> ProjectQuotasInUse:
    """Return the use and the limits of the quotas of a project: items, bytes and running jobs."""
    running, limit = read_limit(tx, project_id)
    shown = show_quotas(tx, "project", project_id)
    jobs = RunningJobs(used=running, allowed=limit)
    return ProjectQuotasInUse(items=shown.items, stored_bytes=shown.stored_bytes, running_jobs=jobs)


def change_project_limits(
    tx: Transaction, project_id: str, name: str, change: ProjectQuotaChange
) -> ProjectQuotasInUse:
    """Change the quotas of a project, and return all of its quotas and their use.

    The caller must have checked that the principal is an administrator.
    """
    if "running_jobs" in change.model_fields_set:
        set_limit(tx, project_id, change.running_jobs)
        tx.execute(update(project).where(project.c.id == project_id).values(rev=project.c.rev + 1))
    limits = change_limits(tx, project_id, change)
    _, most_running = read_limit(tx, project_id)
    if most_running is not None:
        limits = {**limits, "running_jobs": most_running}
    tx.audit("project.limited", project_id, about=name, project_id=project_id, limits=limits)
    return show_project_quotas(tx, project_id)


def change_user_limits(tx: Transaction, user_id: str, name: str, change: QuotaChange) -> QuotasInUse:
    """Change the quotas of a user, and return all of its quotas and their use.

    The caller must have checked that the principal is an administrator.
    """
    tx.audit("user.limited", user_id, about=name, limits=change_limits(tx, user_id, change))
    return show_quotas(tx, "user", user_id)
