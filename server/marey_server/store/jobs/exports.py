"""Consents of performers for jobs that export clips to files: which consents have ended, and permissions to export."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from marey_schemas.access import Role
from marey_schemas.consents import ConsentOverride
from marey_schemas.queue.job_kinds import UnknownKindError, find_kind
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_server.access import roles
from marey_server.errors import ForbiddenProblem
from marey_server.store.items.consents import EndedConsent, find_ended_consents, record_override
from marey_server.store.projects import ProjectRow
from marey_server.store.transaction import Transaction

ENDED = "consent_ended"
"""Name of a member of two kinds of documents.

In the result of an export job, the member contains the ids of all clips of the export whose consent had ended. In the
inputs that a worker gets, each clip whose consent has ended has the member; it contains the last day of the consent.
"""


def ended_inputs(tx: Transaction, kind: KindDeclaration, inputs: Mapping[str, Any]) -> dict[str, EndedConsent]:
    """Return, by id, the clips that a job of the kind writes to files and whose consent has ended.

    Inputs that are not known yet are left out.
    """
    return find_ended_consents(tx, _exported_items(kind, inputs)) if kind.exports is not None else {}


def _exported_items(kind: KindDeclaration, inputs: Mapping[str, Any]) -> Iterator[str]:
    exported = (pin for name, pins in inputs.items() if kind.is_exported(name) for pin in pins)
    return (pin["item"] for pin in exported if "item" in pin)


def lease_inputs(
    tx: Transaction, jobs: Iterable[tuple[str, Mapping[str, Any]]]
) -> list[dict[str, list[dict[str, Any]]]]:
    """Return the inputs of each job in the form that a worker gets; `jobs` gives the kind and the inputs of each.

    Each clip that a job exports and whose consent has ended gets the additional member `ENDED`, the last day of the
    consent. The consent has ended if this day is before today (UTC), whenever the job was submitted.
    """
    declared = [(_declared(name), inputs) for name, inputs in jobs]
    exporting = [(kind, inputs) for kind, inputs in declared if kind is not None and kind.exports is not None]
    ended = find_ended_consents(tx, (one for kind, inputs in exporting for one in _exported_items(kind, inputs)))
    return [_with_ended(kind, inputs, ended) for kind, inputs in declared]


def _declared(kind_name: str) -> KindDeclaration | None:
    """Return the declaration of a kind, or None for a kind of a worker with job kinds of its own."""
    try:
        return find_kind(kind_name)
    except UnknownKindError:
        return None


def _with_ended(
    kind: KindDeclaration | None, inputs: Mapping[str, Any], ended: Mapping[str, EndedConsent]
) -> dict[str, list[dict[str, Any]]]:
    if kind is None or kind.exports is None or not ended:
        return dict(inputs)
    return {
        name: [
            pin | {ENDED: ended[pin["item"]].until} if kind.is_exported(name) and pin.get("item") in ended else pin
            for pin in pins
        ]
        for name, pins in inputs.items()
    }


def may_share(tx: Transaction, kind_name: str, inputs: Mapping[str, Any], result: Mapping[str, Any] | None) -> bool:
    """Return whether consents allow a new job to share the result of an identical job.

    If the job exports clips, the clips whose consent has ended must be the same for both jobs. So the result is not
    shared if the consent for a further clip has ended since, or if a consent was prolonged.
    """
    kind = _declared(kind_name)
    return (
        kind is None
        or kind.exports is None
        or ended_inputs(tx, kind, inputs).keys() == set((result or {}).get(ENDED, ()))
    )


def record_permission(
    tx: Transaction,
    project: ProjectRow,
    job_id: str,
    kind: KindDeclaration,
    params: Mapping[str, Any],
    inputs: Mapping[str, Any],
) -> None:
    """Record an event if a new job may export clips whose consent has ended; the event names these clips.

    The event does not name clips that are not known yet, or whose consent ends between now and the run of the job; the
    result of the job names all of them. Raises `ForbiddenProblem` unless the caller is a maintainer or an owner.
    """
    if kind.exports is None or not params.get("allow_expired_consent"):
        return
    if not roles.includes(project.role, Role.MAINTAINER):
        raise ForbiddenProblem(
            f"A job with `allow_expired_consent` requires at least the role {Role.MAINTAINER.value} in the project "
            f"{project.name!r}; without it, the job leaves out the clips whose consent has ended.",
            code="insufficient-role",
        )
    override = ConsentOverride.model_validate({name: params[name] for name in ConsentOverride.model_fields})
    record_override(tx, project.id, job_id, override, list(ended_inputs(tx, kind, inputs).values()))
