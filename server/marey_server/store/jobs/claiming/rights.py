"""Rights of the callers that claim jobs: workers with a user's token, and pods that were started for one job.

The token of a pod is derived from the id of the job for which the pod is started, and from the key of the servers. So
the token needs no row, and a server that repeats the start of a pod creates the same token again. With the token, the
pod can claim only this job, or one of the tasks of this job.
"""

from __future__ import annotations

import hmac

from sqlalchemy import select

from marey_schemas.queue.jobs import JobState
from marey_schemas.queue.own_pods import OWN_POD_LABEL
from marey_schemas.queue.worker_protocol import ClaimRequest
from marey_server.access.labels import first_outside
from marey_server.access.principal import Principal
from marey_server.errors import ForbiddenProblem
from marey_server.store.credentials.server_key import read_server_key
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction

_POD = "mareypod_"


def read_pod_key(tx: Transaction) -> bytes:
    """Return the key from which the tokens of pods are derived."""
    return hmac.digest(read_server_key(tx), b"tokens of pods", "sha256")


def pod_token(key: bytes, job_id: str) -> str:
    """Return the token with which a pod can claim a job, or a task of this job."""
    return f"{_POD}{job_id}.{hmac.digest(key, job_id.encode(), 'sha256').hex()}"


def resolve_pod_token(tx: Transaction, text: str) -> Principal | None:
    """Return the principal of a pod's token; None if the text is no such token, or if the job does not exist."""
    job_id = text.removeprefix(_POD).partition(".")[0]
    if not text.startswith(_POD) or not text.isascii():
        return None
    key = read_pod_key(tx)
    if not hmac.compare_digest(text, pod_token(key, job_id)) or _read_state(tx, job_id) is None:
        return None
    token_key = hmac.digest(key, f"claims of {job_id}".encode(), "sha256")
    return Principal("pod", scopes=("work",), token_id=job_id, job_id=job_id, token_key=token_key)


def require_worker(caller: Principal, request: ClaimRequest) -> list[str]:
    """Return the caller's scopes `work`; each of them is for all projects or for one project.

    Raises `ForbiddenProblem` if the caller has none, announces a label that its token does not allow, or is a pod that
    claims another job than its own.
    """
    scopes = [scope for scope in caller.scopes if scope.partition("!")[0] == "work"]
    if not scopes or caller.kind not in ("user", "system", "pod"):
        raise ForbiddenProblem("Claiming jobs needs a user's token with the scope `work`.", code="insufficient-scope")
    if caller.kind == "pod":
        if request.job != caller.job_id:
            raise ForbiddenProblem(
                "The token of a pod can claim only the job for which the pod was started.", code="not-for-pods"
            )
        return scopes
    if OWN_POD_LABEL in request.labels:
        raise ForbiddenProblem(
            f"The worker announces the label {OWN_POD_LABEL!r}, which is reserved for pods that were started for one "
            "job. Start the worker without this label.",
            code="label-not-allowed",
            context={"label": OWN_POD_LABEL},
        )
    if (beyond := first_outside(request.labels, caller.labels)) is not None:
        raise ForbiddenProblem(
            f"The worker announces the label {beyond!r}, but its token is bound to other labels. Start the worker "
            "without this label, or with a token that allows it.",
            code="label-not-allowed",
            context={"label": beyond},
        )
    return scopes


def named_job(tx: Transaction, request: ClaimRequest) -> str | None:
    """Return the id of the job, or of the task, that a claim names.

    Returns None if the claim names no job, and "" if the task does not exist.
    """
    if request.task is None or request.job is None:
        return request.job
    task = select(job.c.id).where(job.c.parent_id == request.job, job.c.position == request.task)
    return tx.execute(task).scalar_one_or_none() or ""


def state_of_named(tx: Transaction, request: ClaimRequest) -> JobState | None:
    """Return the state of the job that a claim names; None if there is no such job.

    Callers other than pods and administrators get None, because they may not know which jobs exist.
    """
    if tx.principal.kind != "pod" and not tx.principal.administrator:
        return None
    return _read_state(tx, named_job(tx, request))


def _read_state(tx: Transaction, job_id: str | None) -> JobState | None:
    state = tx.execute(select(job.c.state).where(job.c.id == job_id)).scalar_one_or_none()
    return None if state is None else JobState(state)
