"""Administration of access: users, tokens, and members of projects with their roles."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

from marey_client.arguments import checked, checks_arguments
from marey_client.errors import UnexpectedAnswer
from marey_client.handles.invitations import AccountInvitations
from marey_client.paging import pages
from marey_client.transport import Transport, as_json, named_path, read_model
from marey_schemas.access import (
    EndTokens,
    FolderRole,
    FolderRoleChange,
    Me,
    Member,
    MemberChange,
    NewToken,
    QuotaChange,
    QuotasInUse,
    Role,
    Token,
    TokenCreate,
    TokenRotation,
    User,
    UserChange,
    UserCreate,
)
from marey_schemas.items import Collection
from marey_schemas.sign_ins import Identity, IdentityLink

ANY_STATE = {"If-Match": "*"}
"""Header that makes the server accept a change even if the resource has changed since the caller read it."""


Q = TypeVar("Q", bound=QuotasInUse)


def change_quotas(transport: Transport, path: str, change: QuotaChange, answer: type[Q]) -> Q:
    """Change quotas of the project or user at `path`, a path of the REST API; return all quotas and their use."""
    return read_model(answer, transport.send("PATCH", path, content=as_json(change), repeatable=True))


@checks_arguments
@dataclass(frozen=True)
class Users:
    """Users of a server, managed by administrators."""

    transport: Transport

    @property
    def invitations(self) -> AccountInvitations:
        """The invitations with which people can create an account."""
        return AccountInvitations(self.transport, "/invitations")

    def list(self) -> Iterator[User]:
        """List the users of the server."""
        return pages(self.transport, User, "/users")

    def get(self, name: str) -> User:
        """Return the user with this name. Raises `NotFound` if there is none."""
        return self.transport.get(User, _user(name))

    def create(self, user: UserCreate) -> User:
        """Create a user. Raises `Conflict` if the name is taken."""
        return self.transport.post(User, "/users", user, repeatable=False)

    def change(self, name: str, change: UserChange) -> User:
        """Change a user. Users who change their own password must also send their current password."""
        return read_model(User, self.transport.send("PATCH", _user(name), content=as_json(change), headers=ANY_STATE))

    def disable(self, name: str) -> None:
        """Disable a user: password, tokens and sign-ins do not work until `enable` is called. The data is kept.

        Also pauses the user's schedules and withdraws the user's invitations; `enable` does not undo this.
        """
        self.transport.send("DELETE", _user(name), headers=ANY_STATE)

    def identities(self, name: str) -> Iterator[Identity]:
        """List the people at identity providers who can sign in as a user."""
        return pages(self.transport, Identity, f"{_user(name)}/identities")

    def link(self, name: str, identity: IdentityLink) -> Identity:
        """Link a person at an identity provider with a user; the person can then sign in as this user."""
        return self.transport.post(Identity, f"{_user(name)}/identities", identity, repeatable=True)

    def unlink(self, name: str, identity_id: str) -> None:
        """Remove the link between a person at an identity provider and a user, and end all sign-ins of the user."""
        self.transport.send("DELETE", named_path(f"{_user(name)}/identities", identity_id), repeatable=False)

    def end_tokens(self, name: str, which: EndTokens = EndTokens.ALL) -> User:
        """Revoke all tokens of a user, or only the tokens from `marey login`; the token of this client stays valid."""
        return self.change(name, checked(UserChange, end_tokens=which))

    def quotas(self, name: str) -> QuotasInUse:
        """Return the number of items and bytes that count towards a user's quotas, and the limits."""
        return self.transport.get(QuotasInUse, f"{_user(name)}/quotas")

    def change_quotas(self, name: str, change: QuotaChange) -> QuotasInUse:
        """Change the quotas of a user; None restores the limit of the server's settings. For administrators."""
        return change_quotas(self.transport, f"{_user(name)}/quotas", change, QuotasInUse)

    def enable(self, name: str) -> User:
        """Enable a disabled user again, with the same password and tokens; the user's schedules stay paused."""
        return self.change(name, checked(UserChange, disabled=False))


@checks_arguments
@dataclass(frozen=True)
class Tokens:
    """Tokens of the caller; administrators can also list and revoke tokens of other users."""

    transport: Transport

    def list(
        self,
        *,
        user: str | None = None,
        everybody: bool = False,
        prefix: str | None = None,
        ends_within_s: int | None = None,
    ) -> Iterator[Token]:
        """List tokens without their secrets: by default, your own.

        Administrators can list the tokens of another `user`, or of all users (`everybody`).

        `prefix` selects the token whose secret begins with `marey_<prefix>_`. `ends_within_s` selects the tokens that
        expire within this number of seconds.
        """
        params = {"user": user, "everybody": everybody or None, "prefix": prefix, "ends_within_s": ends_within_s}
        return pages(self.transport, Token, "/tokens", params)

    def create(self, token: TokenCreate) -> NewToken:
        """Create a token. The result contains the secret of the token, which cannot be read later."""
        return self.transport.post(NewToken, "/tokens", token, repeatable=False)

    def rotate(self, rotation_id: str | None = None, *, grace: timedelta = timedelta(hours=1)) -> NewToken:
        """Replace the token of this client by a new token, its successor, with the same rights and the same expiry.

        This client continues to send the replaced token, which stays valid for the duration `grace`. A call with the
        same `rotation_id`, for example after a crash, returns the same successor; the default is a new random id.
        """
        transport = self.transport.with_present_token()
        found = transport.get(Me, "/me").token
        if found is None:
            raise UnexpectedAnswer(
                "the server does not report which token it received, so the token cannot be rotated; upgrade the server"
            )
        wanted = TokenRotation(rotation_id=rotation_id or secrets.token_hex(16), grace_s=int(grace.total_seconds()))
        return transport.post(NewToken, f"/tokens/{found}/rotate", wanted, repeatable=True)

    def revoke(self, token_id: str, *, with_created: bool = False) -> None:
        """Revoke a token at once; with `with_created`, also revoke the tokens that were created with this token."""
        self.transport.send("DELETE", named_path("/tokens", token_id), params={"with_created": with_created or None})


def _user(name: str) -> str:
    return named_path("/users", name)


@checks_arguments
@dataclass(frozen=True)
class Members:
    """Members of a project, each with a role in the project; in some folders, members may have other roles."""

    transport: Transport
    project: str

    def list(self) -> Iterator[Member]:
        """List the members of the project with their roles; roles in folders are in `in_folders`."""
        return pages(self.transport, Member, f"/projects/{self.project}/members")

    def put(self, user: str, role: Role) -> Member:
        """Add a user to the project with the given role, or give a member this role."""
        return read_model(
            Member,
            self.transport.send(
                "PUT",
                named_path(f"/projects/{self.project}/members", user),
                content=as_json(checked(MemberChange, role=role)),
                headers=ANY_STATE,
                repeatable=True,
            ),
        )

    @property
    def in_folders(self) -> FolderRoles:
        """The roles that members have in folders; inside a folder, they replace the role in the project."""
        return FolderRoles(self.transport, self.project)

    def remove(self, user: str) -> None:
        """Remove a user from the project, and remove the user's roles in folders."""
        self.transport.send(
            "DELETE", named_path(f"/projects/{self.project}/members", user), headers=ANY_STATE, repeatable=False
        )


@checks_arguments
@dataclass(frozen=True)
class FolderRoles:
    """Roles of members in folders of a project, and in everything below these folders.

    The name `*` (`marey_schemas.access.EVERY_MEMBER`) stands for all members without a role of their own in the folder.
    """

    transport: Transport
    project: str

    def list(self, folder: str = "", *, user: str | None = None) -> Iterator[FolderRole]:
        """List the roles in a folder and the folders below it, by path; with `user`, only the roles of this member."""
        params = {"folder": folder or None, "user": user}
        return pages(self.transport, FolderRole, f"/projects/{self.project}/folder-roles", params)

    def put(self, folder: Collection, user: str, role: Role) -> FolderRole:
        """Set the role of a member in a folder: reader, contributor or maintainer."""
        change = checked(FolderRoleChange, {"role": role})
        return read_model(
            FolderRole,
            self.transport.send(
                "PUT", self._url(folder, user), content=as_json(change), headers=ANY_STATE, repeatable=True
            ),
        )

    def remove(self, folder: Collection, user: str) -> None:
        """Remove a member's role in a folder; then the member's role in a folder above, or in the project, applies."""
        self.transport.send("DELETE", self._url(folder, user), headers=ANY_STATE, repeatable=False)

    def _url(self, folder: Collection, user: str) -> str:
        return named_path(f"/projects/{self.project}/collections/{folder.id}/roles", user)
