"""Principal: the user, worker or anonymous client on whose behalf a transaction runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from marey_schemas.access import Scope


@dataclass(frozen=True, slots=True)
class Principal:
    """Caller, with the scopes of its credential.

    `scopes` are texts such as `write` or `write!project=walk`. The kind `attempt` is a worker that runs a job. Such a
    worker does not have the rights of a user, not even those of the job's author. It may read the inputs of the job and
    the documents to which these inputs refer. It may write only data of its attempt. After the end of the attempt
    (`ended`), the worker may only repeat the request that ended the attempt. The kind `pod` is a pod that was started
    for the job `job_id`; it may only claim this job. The kind `participant` is a participant of a study, who has no
    account; such a caller may only take part in this study.
    """

    kind: Literal["anonymous", "user", "attempt", "pod", "participant", "system"]
    user_id: str | None = None
    user_name: str | None = None
    administrator: bool = False
    scopes: tuple[str, ...] = ()
    token_id: str | None = None
    expires_us: int | None = None
    job_id: str | None = None
    fence: int | None = None
    project_id: str | None = None
    participant_id: str | None = None
    token_key: bytes = field(default=b"", repr=False)
    """Key from which attempt tokens and the successor of the user's token are derived; empty without a user's token."""
    ended: bool = False
    labels: Mapping[str, str] | None = field(default=None, hash=False)
    """Labels that a worker with this token may announce; None if it may announce any."""

    @property
    def actor(self) -> str | None:
        """The caller in events and as author: the name of a user, or `job:<id>` for an attempt; None for all others."""
        return self.user_name if self.kind != "attempt" else f"job:{self.job_id}"

    def require_user_name(self) -> str:
        """Return the name of the user. Raises `TypeError` if the principal is not a user."""
        if self.user_name is None:
            raise TypeError(f"a principal of the kind {self.kind} is not a user")
        return self.user_name


ANONYMOUS = Principal("anonymous")
SYSTEM = Principal("system", administrator=True, scopes=tuple(scope.value for scope in Scope))
"""Principal of work that the server does for itself, such as garbage collection or the first start."""
