"""Protection of branches in requests and answers."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from marey_schemas.access import Role
from marey_schemas.base import Request
from marey_schemas.names import USER

MOST_REQUIRED = 20
"""Greatest number of approvals, and of checks, that the rule of a branch can require."""

CheckName = Annotated[str, StringConstraints(pattern=USER)]
"""Name of a check of a proposal, such as `evaluation`."""


class ProtectionRule(Request):
    """Rule of a protected branch: the users who may move it, and the conditions for merging a proposal into it.

    A branch with a rule cannot be deleted, and moves only to descendants of its newest commit.
    """

    role: Role = Field(Role.CONTRIBUTOR, description="Lowest role of a user who may move the branch.")
    direct_commits: bool = Field(
        False,
        description="Whether commits and merges without a proposal are allowed; cannot be combined with `approvals`, "
        "`checks` or `up_to_date`.",
    )
    approvals: int = Field(
        0, ge=0, le=MOST_REQUIRED, description="Number of users, other than the author, who must approve a proposal."
    )
    checks: tuple[CheckName, ...] = Field(
        (), max_length=MOST_REQUIRED, description="Checks that must have succeeded for the proposed commit."
    )
    up_to_date: bool = Field(
        False,
        description="Whether a proposal must contain the newest commit of the branch, so that reviewers and checks "
        "have seen exactly the version that the merge makes.",
    )

    @model_validator(mode="after")
    def _is_consistent(self) -> ProtectionRule:
        if self.role is Role.READER:
            raise ValueError("role: readers can never move a branch; set role to contributor, maintainer or owner")
        if self.direct_commits and (self.approvals or self.checks or self.up_to_date):
            raise ValueError(
                "direct_commits: direct commits would bypass approvals, checks and up_to_date; set direct_commits to "
                "false, or require none of these"
            )
        return self


class Protection(ProtectionRule):
    """Rule of a protected branch, as answers about the branch contain it."""

    model_config = ConfigDict(extra="ignore")
