"""Execution of a request in one transaction: identifies the caller, runs the function and renders the answer.

These steps run in one thread of the database's pool, so that an ordinary request leaves the event loop only once.
Only documents that were loaded from the store are encoded in another thread.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from tornado.httputil import HTTPServerRequest

from marey_schemas.encoding.digests import digest_of_hash
from marey_server.access import scopes
from marey_server.access.principal import ANONYMOUS, Principal
from marey_server.access.secret_tokens import hash_secret
from marey_server.errors import BadRequestProblem, ForbiddenProblem, UnauthenticatedProblem
from marey_server.http.declarations import Access, Operation
from marey_server.http.reply import AnswerCache, AnswerForm, LoadedDocument, Rendered, Reply, load_content, render
from marey_server.store import idempotency, projects
from marey_server.store.credentials import tokens
from marey_server.store.idempotency import StoredAnswer
from marey_server.store.jobs.fencing import lease_lost, require_attempt
from marey_server.store.jobs.reading import find_job
from marey_server.store.transaction import Transaction

T = TypeVar("T")

_KEY = re.compile(r"[\x21-\x7e]{1,255}")
CHALLENGE = {"WWW-Authenticate": 'Bearer realm="marey"'}


@dataclass
class Caller:
    """Credential of a request, and the principal that it belongs to."""

    token: str | None
    operation: Operation
    principal: Principal | None = None

    def identify(self, tx: Transaction) -> None:
        """Find the credential's principal, check whether it may perform the operation, and set `tx.principal`.

        The store enforces the role that the operation declares. Raises `UnauthenticatedProblem` if the credential is
        not valid or is missing, and `ForbiddenProblem` if the principal may not perform the operation.
        """
        self.principal = ANONYMOUS if self.token is None else tokens.resolve_token(tx, self.token)
        require_access(self.operation, self.principal)
        tx.principal = self.principal
        tx.required_role = self.operation.required_role

    def sees_answer(self, project: str | None) -> bool:
        """Return whether the caller may read the answer.

        If a change answers with content of the project, the caller needs the scope `read` in the project, too.
        """
        return not self.operation.shows_project or self._reads(project)

    def sees_names(self, project: str | None) -> bool:
        """Return whether an error may name objects that the request does not name, as in `ApiProblem`.

        A caller who may change the project, but not read it, must not learn the names of its content.
        """
        changes_project = self.operation.access.role is not None and self.operation.scope != "read"
        return not changes_project or self._reads(project)

    def _reads(self, project: str | None) -> bool:
        """Return whether the caller has the scope `read` in a project.

        Without a project in the address, the caller needs the scope in all projects in which the operation is possible.
        """
        held = self.principal.scopes if self.principal is not None else ()
        if project is not None:
            return scopes.allows(held, "read", project)
        return all(
            scopes.allows(held, "read", one or None) for one in scopes.projects_of(held, self.operation.scope or "")
        )


@dataclass(frozen=True, slots=True)
class BodyTarget:
    """Target of a request with a body: a project, or an attempt of a job.

    A project is given by its name, an attempt by the job's id and the fence (number of the claim). The caller needs a
    role in this project, or the token of this attempt.
    """

    project: str | None = None
    attempt: tuple[str, int] | None = None


Admission = tuple[str, Access, str | None, bool, bool, bool, bool, BodyTarget]
"""Key of a cached decision to receive a body: hash of the token, declarations of the operation, and target."""


def admission_of(caller: Caller, target: BodyTarget) -> Admission:
    """Return the cache key of the decision whether a caller may send the body of a request."""
    operation = caller.operation
    return (
        hash_secret(caller.token or ""), operation.access, operation.scope, operation.public, operation.attempts,
        operation.replays, operation.in_folders, target,
    )  # fmt: skip


def require_access(operation: Operation, principal: Principal) -> None:
    """Refuse callers who may not perform the operation on any object, whatever their roles in projects are.

    Raises `UnauthenticatedProblem` for an anonymous caller, `LeaseLostProblem` for an attempt that has ended, and
    `ForbiddenProblem` for all other callers.
    """
    access = operation.access
    guests = access is Access.ANYONE or (access is Access.READER and operation.public)
    if principal.kind == "anonymous":
        if not guests:
            raise UnauthenticatedProblem(
                "The request needs a token; send the header Authorization: Bearer <token>.", headers=CHALLENGE
            )
        return
    if principal.kind == "attempt":
        _require_attempt_access(operation, principal)
        return
    if principal.kind == "pod" and access is not Access.WORKER:
        raise ForbiddenProblem(
            "The token of a pod can claim only the job for which the pod was started.", code="not-for-pods"
        )
    if principal.kind == "participant" or access is Access.PARTICIPANT:
        _require_participation(access, principal)
        return
    if access is Access.ATTEMPT:
        raise ForbiddenProblem(
            "This request needs the token that a worker gets for a running job.", code="attempt-only"
        )
    if access is Access.ADMINISTRATOR and not principal.administrator:
        raise ForbiddenProblem("Only administrators may do this.", code="administrators-only")
    if operation.scope is not None and not scopes.reaches_somewhere(principal.scopes, operation.scope):
        raise ForbiddenProblem(
            f"This request needs a token with the scope {operation.scope!r}.",
            code="insufficient-scope",
            context={"scope": operation.scope},
        )


def _require_attempt_access(operation: Operation, principal: Principal) -> None:
    """Refuse requests that an attempt of a job may not send.

    An attempt may use its own endpoints and read its inputs and files. After its end, it may only repeat its last
    request.
    """
    if operation.access is Access.ANYONE:
        return
    if principal.ended and not operation.replays:
        raise lease_lost(principal.job_id or "", principal.fence or 0)
    if operation.access is not Access.ATTEMPT and not operation.attempts:
        raise ForbiddenProblem(
            "The token that a worker gets for a running job may not do this.", code="not-for-attempts"
        )


def _require_participation(access: Access, principal: Principal) -> None:
    """Require that an operation for participants has a participant as its caller, and that other operations do not.

    Operations that anyone may perform are always allowed. Called only if the caller is a participant, or if the
    operation is for participants. Raises `ForbiddenProblem`.
    """
    if access is Access.ANYONE:
        return
    if access is not Access.PARTICIPANT:
        raise ForbiddenProblem("The token of a participant of a study may not do this.", code="not-for-participants")
    if principal.kind != "participant":
        raise ForbiddenProblem(
            "This request needs the token that a participant of a study gets for a link.", code="participants-only"
        )


@dataclass(frozen=True, slots=True)
class IdempotentRequest:
    """Request with an idempotency key; a repetition of the request gets the stored answer."""

    key: str
    fingerprint: str
    project: str | None
    """Name of the project in the address, if any."""
    job: str | None
    """Id of the job in the address, if any."""


@dataclass(frozen=True)
class Call:
    """Function that a request runs in a transaction, and the form of its answer."""

    caller: Caller
    form: AnswerForm
    answers: AnswerCache
    to_reply: Callable[[Any], Reply]
    function: Callable[..., Any]
    args: tuple[Any, ...] = ()
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    idempotent: IdempotentRequest | None = None
    """The request, if it has an idempotency key."""


def run_call(call: Call, tx: Transaction) -> Rendered | Reply:
    """Run the function of a request, only once for each idempotency key, and encode the answer.

    If the answer is a loaded document, it is returned without being encoded.
    """
    call.caller.identify(tx)
    idempotent = call.idempotent
    if idempotent is not None:
        stored = idempotency.begin(tx, idempotent.key, idempotent.fingerprint)
        if stored is not None:
            return _repeated(tx, call.caller, idempotent, stored)
    reply = load_content(call.to_reply(call.function(tx, *call.args, **call.kwargs)), call.form, call.answers)
    if isinstance(reply.content, LoadedDocument):
        return reply
    rendered = render(reply, call.form, call.answers)
    if idempotent is not None:
        idempotency.finish(tx, idempotent.key, rendered.status, dict(rendered.headers), rendered.body)
    return rendered


def find_first_answer(caller: Caller, idempotent: IdempotentRequest, tx: Transaction) -> Rendered | None:
    """Return the answer to an earlier, equal request with the same idempotency key, or None if the key is new.

    Raises `InvalidProblem` if the key was used for another request, and refuses callers who have lost their role in the
    project since.
    """
    caller.identify(tx)
    stored = idempotency.find(tx, idempotent.key, idempotent.fingerprint)
    return None if stored is None else _repeated(tx, caller, idempotent, stored)


def _repeated(tx: Transaction, caller: Caller, idempotent: IdempotentRequest, stored: StoredAnswer) -> Rendered:
    if caller.operation.access.role is not None:
        _require_role_again(idempotent, tx)
    return Rendered(stored.status, {**stored.headers, "Idempotent-Replayed": "true"}, stored.body)


def _require_role_again(idempotent: IdempotentRequest, tx: Transaction) -> None:
    """Refuse a caller who has lost the role in the project since the first request with the same idempotency key.

    The project is the one in the address of the request, or the project of the job in the address.
    """
    if idempotent.project is not None:
        projects.require(tx, idempotent.project)
    if idempotent.job is not None:
        find_job(tx, idempotent.job)


def admit(tx: Transaction, target: BodyTarget) -> None:
    """Refuse a caller who lacks the role that the operation declares for the project.

    If the operation belongs to an attempt of a job, only the token of this attempt is admitted. The credential must
    have been checked before in the same transaction, as `run_plain` does.
    """
    if target.project is not None:
        projects.require(tx, target.project)
    if target.attempt is not None:
        require_attempt(tx.principal, *target.attempt)


def run_plain(caller: Caller, function: Callable[[Transaction], T], tx: Transaction) -> T:
    """Identify the caller in the transaction, run a function on the caller's behalf, and return its result."""
    caller.identify(tx)
    return function(tx)


# -- idempotency -------------------------------------------------------------------------------------------------------


def idempotent_request(
    request: HTTPServerRequest, body: bytes | bytearray, project: str | None, job: str | None
) -> IdempotentRequest | None:
    """Return a request with its header Idempotency-Key, or None if it has no such header.

    `project` and `job` are the name of the project and the id of the job in the address, if any. Raises
    `BadRequestProblem` if the header is malformed.
    """
    key = request.headers.get("Idempotency-Key")
    if key is None:
        return None
    if not _KEY.fullmatch(key):
        raise BadRequestProblem(
            "The header Idempotency-Key must have 1 to 255 visible ASCII characters.", code="bad-idempotency-key"
        )
    return IdempotentRequest(key, _fingerprint_of(request, body), project, job)


def _fingerprint_of(request: HTTPServerRequest, body: bytes | bytearray) -> str:
    """Return a digest of a request, to refuse a different request with the same idempotency key."""
    digest = hashlib.sha256(f"{request.method} {request.uri}\n".encode())
    digest.update(request.headers.get("Content-Type", "").encode() + b"\n")
    digest.update(body)
    return digest_of_hash(digest)
