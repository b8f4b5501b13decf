"""Audit log: who granted or withdrew access, or deleted or restored an object, and when."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from pydantic import Field

from marey_schemas.base import Answer
from marey_schemas.event_kinds import AuditKind

AUDIT_WORDS: Mapping[AuditKind, str] = {
    "project.created": "created the project",
    "project.changed": "changed the project",
    "project.deleted": "deleted the project",
    "project.restored": "restored the project",
    "project.limited": "changed the quotas of the project",
    "member.added": "added the member",
    "member.changed": "changed the role of the member",
    "member.removed": "removed the member",
    "folder_role.added": "gave a role in a folder to",
    "folder_role.changed": "changed the role in a folder of",
    "folder_role.removed": "removed the role in a folder of",
    "invitation.created": "created the invitation",
    "invitation.withdrawn": "withdrew the invitation",
    "invitation.accepted": "accepted the invitation",
    "collection.deleted": "deleted the collection",
    "collection.restored": "restored the collection",
    "item.deleted": "deleted the item",
    "item.restored": "restored the item",
    "item.purged": "purged the item",
    "consent.overridden": "allowed an export after the end of the consent for",
    "dataset.deleted": "deleted the dataset",
    "dataset.purged": "purged the dataset",
    "branch.deleted": "deleted a branch of the dataset",
    "branch.reset": "reset a branch of the dataset",
    "branch.protected": "protected a branch of the dataset",
    "branch.unprotected": "removed the protection of a branch of the dataset",
    "tag.deleted": "deleted a tag of the dataset",
    "webhook.created": "created a webhook to the host",
    "webhook.changed": "changed a webhook to the host",
    "webhook.rotated": "replaced the secret of a webhook to the host",
    "webhook.deleted": "deleted a webhook to the host",
    "schedule.created": "created the schedule",
    "schedule.changed": "changed the schedule",
    "schedule.deleted": "deleted the schedule",
    "script.registered": "registered the script",
    "script.deleted": "deleted the script",
    "study.invited": "created links for participants of the study",
    "study.withdrawn": "deleted the records of a participant of the study",
    "user.created": "created the user",
    "user.changed": "changed the user",
    "user.limited": "changed the quotas of the user",
    "identity.linked": "linked a person at an identity provider with the user",
    "identity.unlinked": "ended the link of a person at an identity provider with the user",
    "token.created": "created a token of the user",
    "token.rotated": "replaced a token of the user",
    "token.revoked": "revoked a token of the user",
}
"""Words for each kind of entry, such as "added the member"; in a sentence, they stand between `actor` and `about`."""


class AuditEntry(Answer):
    """Entry of the audit log: one change of access, or one deletion or restoration.

    The words of `AUDIT_WORDS` for `kind` connect `actor` and `about`: "ada", "added the member", "ben".
    """

    seq: int = Field(description="Number of the event. The feed of events uses the same number.")
    at: datetime
    kind: str
    project: str | None = Field(description="Present name of the project; null: the entry concerns the whole server.")
    actor: str | None = Field(
        description="Name of the user who made the change, or `job:<id>` for a job; null: the server or a "
        "participant of a study made it."
    )
    token: str | None = Field(None, description="Id of the token that the actor used; null: none, as in a sign-in.")
    about: str = Field(
        description="Name that the changed user or object had at the time of the change. For an item that has been "
        "purged since, the id of the item."
    )
    subject: str = Field(
        description="Id of the object that was changed; for a change of a member, the id of the project."
    )
    body: dict[str, Any] = Field(default_factory=dict, description="Details, such as the new role.")

    @property
    def words(self) -> str:
        """The words of `AUDIT_WORDS` for this kind of entry, such as "added the member"; else `kind` itself."""
        return next((words for kind, words in AUDIT_WORDS.items() if kind == self.kind), self.kind)
