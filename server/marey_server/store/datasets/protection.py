"""Protection of branches: decides whether a branch may be moved or deleted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, or_, select

from marey_schemas.access import Role
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.datasets.protection import Protection
from marey_server.access import roles
from marey_server.errors import ConflictProblem, ForbiddenProblem
from marey_server.store.tables import dataset_ref, proposal
from marey_server.store.transaction import Transaction

CODE = "branch-protected"


@dataclass(frozen=True)
class Mover:
    """User on whose behalf a branch is moved.

    `by_proposal` is true if the move is the merge of a proposal. `user_id` is needed if the move creates items.
    """

    name: str
    role: Role
    by_proposal: bool = False
    user_id: str | None = None


def rule_of(ref: Row[Any]) -> Protection | None:
    """Return the protection rule of a branch; None if the branch is not protected."""
    return None if ref.protection is None else Protection.model_validate(ref.protection)


def require_move(ref: Row[Any], mover: Mover) -> None:
    """Raise an error if the mover may not move a branch forward, to a commit that follows its newest commit.

    Raises `ForbiddenProblem` if the role is too low, and `ConflictProblem` if only proposals move the branch.
    """
    rule = rule_of(ref)
    if rule is None:
        return
    if not roles.includes(mover.role, rule.role):
        raise ForbiddenProblem(
            f"The branch {ref.name!r} is protected; moving it requires at least the role {rule.role.value}.",
            code=CODE,
            unnamed=f"The branch is protected; moving it requires at least the role {rule.role.value}.",
        )
    if not rule.direct_commits and not mover.by_proposal:
        raise ConflictProblem(
            f"The branch {ref.name!r} is protected. Commit to another branch, then open a proposal to merge it.",
            code=CODE,
            unnamed="The branch is protected. Commit to another branch, then open a proposal to merge it.",
        )


def require_reset(ref: Row[Any]) -> None:
    """Raise `ConflictProblem` if a branch is protected against resets.

    A reset moves a branch to a commit that does not follow its newest commit.
    """
    if ref.protection is not None:
        raise ConflictProblem(
            f"The branch {ref.name!r} is protected and cannot be reset; revert single commits instead.", code=CODE
        )


def require_deletable(tx: Transaction, ref: Row[Any]) -> None:
    """Raise `ConflictProblem` if a branch or a tag is protected, or is the source or target of an open proposal."""
    if ref.protection is not None:
        raise ConflictProblem(
            f"The branch {ref.name!r} is protected; remove the protection before you delete the branch.", code=CODE
        )
    about = select(proposal.c.number).where(
        proposal.c.dataset_id == ref.dataset_id,
        proposal.c.state == ProposalState.OPEN.value,
        or_(proposal.c.source == ref.name, proposal.c.target == ref.name),
    )
    number = tx.execute(about.limit(1)).scalar()
    if number is not None:
        raise ConflictProblem(
            f"The open proposal {number} has {ref.name!r} as source or target; merge or close it first.",
            code="proposal-open",
            context={"proposal": number},
        )


def require_no_protected_branch(tx: Transaction, dataset_id: str) -> None:
    """Raise `ConflictProblem` if a dataset has a protected branch."""
    protected = select(dataset_ref.c.name).where(
        dataset_ref.c.dataset_id == dataset_id, dataset_ref.c.protection.is_not(None)
    )
    name = tx.execute(protected.limit(1)).scalar()
    if name is not None:
        raise ConflictProblem(
            f"The branch {name!r} is protected; remove the protection before you delete the dataset.",
            code=CODE,
            unnamed="A branch is protected; remove the protection before you delete the dataset.",
        )
