"""Kinds of events. The type checker compares each event that the server records with this list."""

from __future__ import annotations

from typing import Literal, get_args

ProjectEventKind = Literal[
    "project.created",
    "project.changed",
    "project.deleted",
    "project.restored",
    "project.limited",
    "member.added",
    "member.changed",
    "member.removed",
    "collection.created",
    "collection.moved",
    "collection.deleted",
    "collection.restored",
    "item.created",
    "item.revised",
    "item.changed",
    "item.deleted",
    "item.restored",
    "consent.overridden",
    "dataset.created",
    "dataset.deleted",
    "branch.created",
    "branch.moved",
    "branch.deleted",
    "branch.protected",
    "branch.unprotected",
    "tag.created",
    "tag.deleted",
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
    "webhook.created",
    "webhook.changed",
    "webhook.rotated",
    "webhook.deleted",
    "webhook.requested",
]
"""Kinds of events in a project; a webhook can be notified of each of them."""

ServerEventKind = Literal[
    "user.created",
    "user.changed",
    "user.limited",
    "token.created",
    "token.rotated",
    "token.revoked",
]
"""Kinds of events that belong to no project."""

EventKind = ProjectEventKind | ServerEventKind

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
"""Kinds of a webhook that names none: commits and merges, which move a branch, proposals, and ends of jobs."""
