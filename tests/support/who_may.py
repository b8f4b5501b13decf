"""Model of the rights of callers: the kinds of callers, and how each operation answers each of them.

The model repeats the rules of the server in a second form, so that tests can compare both forms. The table in
docs/explanation/threat-model.md is compared with the model, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from marey_schemas.access import Role
from marey_server.http.declarations import Access, Operation

ALL_SCOPES = ("read", "write", "jobs", "work", "admin")
USER_SCOPES = ("read", "write", "jobs")
ELSEWHERE = tuple(f"{scope}!project=elsewhere" for scope in USER_SCOPES)
RANK = {role: rank for rank, role in enumerate(Role)}

LET_THROUGH: frozenset[int] = frozenset()
"""Verdict for callers who are not refused: the answer depends on the request alone."""
SIGN_IN, FORBIDDEN, HIDDEN, OVER = frozenset({401}), frozenset({403}), frozenset({404}), frozenset({409})


@dataclass(frozen=True)
class Person:
    """Kind of caller of the project `lab`.

    `standing` is the kind of the credential: no credential (`none`), a credential that the server refuses (`refused`),
    or the token of a user (`user`), of a running attempt in `lab` (`attempt`), of an ended attempt in `lab` (`ended`),
    or of a participant of a study in `lab` (`participant`).
    """

    name: str
    standing: Literal["none", "refused", "user", "attempt", "ended", "participant"]
    role: Role | None = None
    administrator: bool = False
    scopes: tuple[str, ...] = USER_SCOPES

    def has(self, scope: str | None) -> bool:
        """Return whether the credential includes a scope in at least one project."""
        return scope is None or any(held.partition("!")[0] == scope for held in self.scopes)

    def reaches(self, project: str) -> bool:
        """Return whether a scope of the credential applies to `project`."""
        return any(held.partition("!project=")[2] in ("", project) for held in self.scopes)

    @property
    def rank(self) -> int:
        """The rank of the caller's role in `lab`, -1 without a role."""
        if not self.reaches("lab"):
            return -1
        role = Role.OWNER if self.administrator else self.role
        return -1 if role is None else RANK[role]


PEOPLE = {
    person.name: person
    for person in (
        Person("anonymous", "none"),
        Person("invented", "refused"),
        Person("expired", "refused", Role.OWNER),
        Person("disabled", "refused", Role.OWNER),
        Person("stranger", "user"),
        Person("bound", "user", Role.OWNER, scopes=ELSEWHERE),
        Person("reader", "user", Role.READER),
        Person("contributor", "user", Role.CONTRIBUTOR),
        Person("maintainer", "user", Role.MAINTAINER),
        Person("owner", "user", Role.OWNER),
        Person("administrator", "user", administrator=True, scopes=ALL_SCOPES),
        Person("worker", "user", administrator=True, scopes=("work",)),
        Person("attempt", "attempt", scopes=("read",)),
        Person("ended", "ended", scopes=()),
        Person("participant", "participant", scopes=()),
    )
}
"""Every kind of caller. `bound`: an owner's token for another project. `worker`: a token that only claims jobs."""


def verdict(person: Person, operation: Operation, *, public: bool = False) -> frozenset[int]:
    """Return the statuses with which an operation on `lab` refuses `person`, or `LET_THROUGH`."""
    access = operation.access
    if access is Access.ANYONE:
        return LET_THROUGH
    if person.standing == "refused":
        return SIGN_IN
    if person.standing == "none":
        return _of_guest(operation, public=public)
    if person.standing == "participant" or access is Access.PARTICIPANT:
        return _of_participant(person, operation)
    if person.standing in ("attempt", "ended"):
        return _of_attempt(person, operation)
    return _of_user(person, operation, public=public)


def _of_guest(operation: Operation, *, public: bool) -> frozenset[int]:
    if operation.access is not Access.READER or not operation.public:
        return SIGN_IN
    return LET_THROUGH if public else HIDDEN


def _of_participant(person: Person, operation: Operation) -> frozenset[int]:
    """Return the statuses with which an operation refuses a participant, or refuses others who want to take part."""
    if person.standing == "ended":
        return OVER
    both = person.standing == "participant" and operation.access is Access.PARTICIPANT
    return LET_THROUGH if both else FORBIDDEN


def _of_attempt(person: Person, operation: Operation) -> frozenset[int]:
    """Return the statuses with which an operation refuses the token of an attempt, or `LET_THROUGH`.

    A running attempt may use the operations for attempts; an attempt that has ended may only repeat its last request.
    """
    if person.standing == "ended":
        return LET_THROUGH if operation.replays else OVER
    return LET_THROUGH if operation.access is Access.ATTEMPT or operation.attempts else FORBIDDEN


def _of_user(person: Person, operation: Operation, *, public: bool) -> frozenset[int]:
    access = operation.access
    if access is Access.ATTEMPT or not person.has(operation.scope):
        return FORBIDDEN
    if access is Access.ADMINISTRATOR:
        return LET_THROUGH if person.administrator else FORBIDDEN
    if access is Access.USER:
        themselves = operation.method == "GET" and operation.etag  # the one user that a token always knows
        return LET_THROUGH if themselves or operation.scope in (None, *person.scopes) else FORBIDDEN
    if access.role is None:
        return LET_THROUGH
    if person.rank < 0:
        return _of_outsider(operation, public=public)
    return LET_THROUGH if person.rank >= RANK[access.role] else FORBIDDEN


def _of_outsider(operation: Operation, *, public: bool) -> frozenset[int]:
    if not public:
        return HIDDEN
    return LET_THROUGH if operation.access is Access.READER and operation.public else FORBIDDEN


def table() -> str:
    """Return the Markdown table of the threat model page: one row per kind of caller, one column per `Access`."""
    words = {LET_THROUGH: "yes", SIGN_IN: "401", FORBIDDEN: "403", HIDDEN: "404", OVER: "409"}
    columns = [access for access in Access if access is not Access.ANYONE]
    lines = ["| caller | " + " | ".join(access.value for access in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for person in PEOPLE.values():
        cells = (words[verdict(person, _sample(access))] for access in columns)
        lines.append(f"| {person.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


_SCOPES = {Access.ADMINISTRATOR: "admin", Access.WORKER: "work", Access.ATTEMPT: None, Access.PARTICIPANT: None}


def _sample(access: Access) -> Operation:
    """Return an operation with this `Access` and its usual scope; guests may perform it in public projects."""
    usual = "read" if access in (Access.READER, Access.SIGNED_IN, Access.USER) else "write"
    return Operation(
        "GET", "", "", access, _SCOPES.get(access, usual), None, None, None, 200, paged=False, etag=False,
        precondition="none", idempotency="nature", answer_types=(), also=(), public=True, headers=(), stream=False,
        reserved=False, attempts=False, replays=False,
    )  # fmt: skip
