"""Kinds of events of projects and of the server. The type checker verifies that no other kinds are recorded.

The audit log consists of the events whose kinds are in `AuditKind`: changes of access, limits, protected branches,
webhooks, schedules, scripts and studies, and deletions and restorations.
"""

from __future__ import annotations

from typing import Literal, get_args

ProjectAuditKind = Literal[
    "project.created",
    "project.changed",
    "project.deleted",
    "project.restored",
    "project.limited",
    "member.added",
    "member.changed",
    "member.removed",
    "folder_role.added",
    "folder_role.changed",
    "folder_role.removed",
    "invitation.created",
    "invitation.withdrawn",
    "invitation.accepted",
    "collection.deleted",
    "collection.restored",
    "item.deleted",
    "item.restored",
    "item.purged",
    "consent.overridden",
    "dataset.deleted",
    "dataset.purged",
    "branch.deleted",
    "branch.reset",
    "branch.protected",
    "branch.unprotected",
    "tag.deleted",
    "webhook.created",
    "webhook.changed",
    "webhook.rotated",
    "webhook.deleted",
    "schedule.created",
    "schedule.changed",
    "schedule.deleted",
    "script.registered",
    "script.deleted",
    "study.invited",
    "study.withdrawn",
]
"""Kinds of audit entries in a project."""

ServerAuditKind = Literal[
    "user.created",
    "user.changed",
    "user.limited",
    "identity.linked",
    "identity.unlinked",
    "token.created",
    "token.rotated",
    "token.revoked",
]
"""Kinds of audit entries that belong to no project."""

AuditKind = Literal[ProjectAuditKind, ServerAuditKind]

OrdinaryEventKind = Literal[
    "collection.created",
    "collection.moved",
    "item.created",
    "item.revised",
    "item.changed",
    "dataset.created",
    "branch.created",
    "branch.moved",
    "tag.created",
    "commit.received",
    "proposal.opened",
    "proposal.commented",
    "proposal.reviewed",
    "proposal.checked",
    "proposal.waiting",
    "proposal.merged",
    "proposal.closed",
    "job.submitted",
    "job.bound",
    "job.started",
    "job.requeued",
    "job.cancel_requested",
    "job.succeeded",
    "job.failed",
    "job.cancelled",
    "schedule.submitted",
    "schedule.refused",
    "webhook.requested",
]
"""Kinds of events in a project that are not in the audit log."""

ProjectEventKind = Literal[ProjectAuditKind, OrdinaryEventKind]
"""Kinds of events in a project; a webhook can be notified of each of them."""

AUDIT_KINDS: tuple[AuditKind, ...] = get_args(AuditKind)
PROJECT_EVENT_KINDS: tuple[ProjectEventKind, ...] = get_args(ProjectEventKind)

DEFAULT_WEBHOOK_KINDS: tuple[ProjectEventKind, ...] = (
    "branch.moved",
    "proposal.opened",
    "proposal.reviewed",
    "proposal.merged",
    "proposal.closed",
    "job.succeeded",
    "job.failed",
    "job.cancelled",
)
"""Kinds of events that a webhook sends by default: moves of branches, by commits or merges; proposals; ends of jobs."""
