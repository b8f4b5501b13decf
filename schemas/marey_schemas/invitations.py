"""Invitations: codes with which people become members of a project, or create their own account.

A code can be used a limited number of times, by default once.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field, SecretStr, StringConstraints, model_validator

from marey_schemas.access import DisplayName, LoginSeconds, NewToken, Password, Role
from marey_schemas.base import Answer, Request
from marey_schemas.names import ProjectName, UserName
from marey_schemas.sizes import DAY_S, LOGIN_DAYS

MAX_DAYS = 30
MAX_USES = 100
CODE_PREFIX = "mareyinvite_"
"""Beginning of every code; the prefix of the invitation and the secret follow, with `_` between them."""

Note = Annotated[str, StringConstraints(max_length=255)]
Code = Annotated[SecretStr, Field(max_length=200)]


class InvitationTerms(Request):
    """Base of requests for invitations: the lifetime and the number of uses of the invitation."""

    note: Note = Field(
        "",
        description="Person or purpose that the invitation is for; shown only to users who may "
        "withdraw the invitation.",
    )
    expires_in_s: int = Field(
        7 * DAY_S,
        ge=60,
        le=MAX_DAYS * DAY_S,
        description="Seconds until the invitation ends, counted from its creation.",
    )
    uses: int = Field(1, ge=1, le=MAX_USES, description="Number of people who can use the invitation.")


class InvitationCreate(InvitationTerms):
    """Request to invite users of the server to a project."""

    role: Role


class AccountInvitationCreate(InvitationTerms):
    """Request to invite people who have no account yet; they choose user name and password themselves."""

    project: ProjectName | None = Field(
        None, description="Project of which the new user becomes a member; null: of none."
    )
    role: Role | None = Field(None, description="Role in the project; needed if a project is named.")

    @model_validator(mode="after")
    def _names_both(self) -> AccountInvitationCreate:
        if (self.project is None) != (self.role is None):
            raise ValueError("project and role belong together: give both, or neither")
        return self


class Invitation(Answer):
    """Open invitation to a project or to the server, without its code."""

    id: str
    prefix: str = Field(description="The text between the two `_` of the code.")
    project: str | None
    role: Role | None
    creates_account: bool = Field(
        description="Whether people without an account can create an account with this invitation."
    )
    note: str
    inviter: str
    created_at: datetime
    expires_at: datetime
    uses: int
    uses_left: int


class NewInvitation(Invitation):
    """New invitation with its code, which is shown only once."""

    code: str


class InvitationAcceptance(Request):
    """Request of a user to accept an invitation to a project."""

    code: Code


class AcceptedInvitation(Answer):
    """Membership of the caller after an invitation was accepted."""

    project: str
    role: Role = Field(description="The caller's role in the project.")
    joined: bool = Field(
        description="Whether the invitation gave the caller this role. False: the caller had the same or a higher role "
        "before, and the invitation was not used."
    )


class SignUp(Request):
    """Request to create an account with an invitation of an administrator."""

    code: Code
    name: UserName
    password: Password
    display_name: DisplayName | None = None
    expires_in_s: LoginSeconds = Field(LOGIN_DAYS * DAY_S, description="Seconds until the returned token ends.")


class SignedUp(NewToken):
    """Token of a new user, shown only once, and the project of which the user is a member now."""

    project: str | None
    role: Role | None
