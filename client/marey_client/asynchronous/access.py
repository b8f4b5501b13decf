"""Counterparts of `marey_client.access` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from datetime import timedelta

from marey_client.access import FolderRoles, Members, Tokens, Users
from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.handles.invitations import AsyncAccountInvitations
from marey_schemas.access import (
    EndTokens,
    FolderRole,
    Member,
    NewToken,
    QuotaChange,
    QuotasInUse,
    Role,
    Token,
    TokenCreate,
    User,
    UserChange,
    UserCreate,
)
from marey_schemas.items import Collection
from marey_schemas.sign_ins import Identity, IdentityLink


@counterpart_of(Users)
class AsyncUsers(Counterpart):
    """Users of a server, managed by administrators."""

    _sync: Users

    @property
    def invitations(self) -> AsyncAccountInvitations:
        """The invitations with which people can create an account."""
        exchanged: AsyncAccountInvitations = self._as_async(self._sync.invitations)
        return exchanged

    def list(self) -> AsyncIterator[User]:
        """List the users of the server."""
        return self._each(self._sync.list)

    async def get(self, name: str) -> User:
        """Return the user with this name. Raises `NotFound` if there is none."""
        return await self._run(self._sync.get, name)

    async def create(self, user: UserCreate) -> User:
        """Create a user. Raises `Conflict` if the name is taken."""
        return await self._run(self._sync.create, user)

    async def change(self, name: str, change: UserChange) -> User:
        """Change a user. Users who change their own password must also send their current password."""
        return await self._run(self._sync.change, name, change)

    async def disable(self, name: str) -> None:
        """Disable a user: password, tokens and sign-ins do not work until `enable` is called. The data is kept.

        Also pauses the user's schedules and withdraws the user's invitations; `enable` does not undo this.
        """
        await self._run(self._sync.disable, name)

    def identities(self, name: str) -> AsyncIterator[Identity]:
        """List the people at identity providers who can sign in as a user."""
        return self._each(self._sync.identities, name)

    async def link(self, name: str, identity: IdentityLink) -> Identity:
        """Link a person at an identity provider with a user; the person can then sign in as this user."""
        return await self._run(self._sync.link, name, identity)

    async def unlink(self, name: str, identity_id: str) -> None:
        """Remove the link between a person at an identity provider and a user, and end all sign-ins of the user."""
        await self._run(self._sync.unlink, name, identity_id)

    async def end_tokens(self, name: str, which: EndTokens = EndTokens.ALL) -> User:
        """Revoke all tokens of a user, or only the tokens from `marey login`; the token of this client stays valid."""
        return await self._run(self._sync.end_tokens, name, which)

    async def quotas(self, name: str) -> QuotasInUse:
        """Return the number of items and bytes that count towards a user's quotas, and the limits."""
        return await self._run(self._sync.quotas, name)

    async def change_quotas(self, name: str, change: QuotaChange) -> QuotasInUse:
        """Change the quotas of a user; None restores the limit of the server's settings. For administrators."""
        return await self._run(self._sync.change_quotas, name, change)

    async def enable(self, name: str) -> User:
        """Enable a disabled user again, with the same password and tokens; the user's schedules stay paused."""
        return await self._run(self._sync.enable, name)


@counterpart_of(Tokens)
class AsyncTokens(Counterpart):
    """Tokens of the caller; administrators can also list and revoke tokens of other users."""

    _sync: Tokens

    def list(
        self,
        *,
        user: str | None = None,
        everybody: bool = False,
        prefix: str | None = None,
        ends_within_s: int | None = None,
    ) -> AsyncIterator[Token]:
        """List tokens without their secrets: by default, your own.

        Administrators can list the tokens of another `user`, or of all users (`everybody`).

        `prefix` selects the token whose secret begins with `marey_<prefix>_`. `ends_within_s` selects the tokens that
        expire within this number of seconds.
        """
        return self._each(self._sync.list, user=user, everybody=everybody, prefix=prefix, ends_within_s=ends_within_s)

    async def create(self, token: TokenCreate) -> NewToken:
        """Create a token. The result contains the secret of the token, which cannot be read later."""
        return await self._run(self._sync.create, token)

    async def rotate(self, rotation_id: str | None = None, *, grace: timedelta = timedelta(hours=1)) -> NewToken:
        """Replace the token of this client by a new token, its successor, with the same rights and the same expiry.

        This client continues to send the replaced token, which stays valid for the duration `grace`. A call with the
        same `rotation_id`, for example after a crash, returns the same successor; the default is a new random id.
        """
        return await self._run(self._sync.rotate, rotation_id, grace=grace)

    async def revoke(self, token_id: str, *, with_created: bool = False) -> None:
        """Revoke a token at once; with `with_created`, also revoke the tokens that were created with this token."""
        await self._run(self._sync.revoke, token_id, with_created=with_created)


@counterpart_of(Members)
class AsyncMembers(Counterpart):
    """Members of a project, each with a role in the project; in some folders, members may have other roles."""

    _sync: Members

    @property
    def project(self) -> str:
        return self._sync.project

    def list(self) -> AsyncIterator[Member]:
        """List the members of the project with their roles; roles in folders are in `in_folders`."""
        return self._each(self._sync.list)

    async def put(self, user: str, role: Role) -> Member:
        """Add a user to the project with the given role, or give a member this role."""
        return await self._run(self._sync.put, user, role)

    @property
    def in_folders(self) -> AsyncFolderRoles:
        """The roles that members have in folders; inside a folder, they replace the role in the project."""
        exchanged: AsyncFolderRoles = self._as_async(self._sync.in_folders)
        return exchanged

    async def remove(self, user: str) -> None:
        """Remove a user from the project, and remove the user's roles in folders."""
        await self._run(self._sync.remove, user)


@counterpart_of(FolderRoles)
class AsyncFolderRoles(Counterpart):
    """Roles of members in folders of a project, and in everything below these folders.

    The name `*` (`marey_schemas.access.EVERY_MEMBER`) stands for all members without a role of their own in the folder.
    """

    _sync: FolderRoles

    @property
    def project(self) -> str:
        return self._sync.project

    def list(self, folder: str = "", *, user: str | None = None) -> AsyncIterator[FolderRole]:
        """List the roles in a folder and the folders below it, by path; with `user`, only the roles of this member."""
        return self._each(self._sync.list, folder, user=user)

    async def put(self, folder: Collection, user: str, role: Role) -> FolderRole:
        """Set the role of a member in a folder: reader, contributor or maintainer."""
        return await self._run(self._sync.put, folder, user, role)

    async def remove(self, folder: Collection, user: str) -> None:
        """Remove a member's role in a folder; then the member's role in a folder above, or in the project, applies."""
        await self._run(self._sync.remove, folder, user)
