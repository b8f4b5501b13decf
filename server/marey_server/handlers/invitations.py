"""Resources of invitations to a project or to the server, and of their acceptance.

The code of an invitation is a secret. It occurs only in bodies of requests, and in the answer to the request that
creates the invitation.
"""

from __future__ import annotations

from marey_schemas.invitations import (
    AcceptedInvitation,
    AccountInvitationCreate,
    Invitation,
    InvitationAcceptance,
    InvitationCreate,
    NewInvitation,
    SignedUp,
    SignUp,
)
from marey_server.handlers.access import MAX_LOGIN_BYTES, PasswordResource
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.invitations import accepting, issuing


class ProjectInvitations(Resource):
    """Invitations to a project."""

    path = "/projects/{project}/invitations"
    tag = "Invitations"

    @reads(access=Access.OWNER, query=PageQuery, answer=Invitation, paged=True, public=False)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the open invitations to a project, without their codes."""
        return await self.answer(issuing.list_invitations, project, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.OWNER, body=InvitationCreate, answer=NewInvitation, status=201)
    async def post(self, project: str, body: InvitationCreate) -> Rendered:
        """Invite users of the server to a project; the code is shown only once."""
        return await self.answer_with(
            lambda made: Reply(made, location=f"/projects/{project}/invitations/{made.id}", headers=WITH_SECRET),
            issuing.create_invitation,
            project,
            body,
        )


class ProjectInvitation(Resource):
    """An invitation to a project."""

    path = "/projects/{project}/invitations/{invitation}"
    tag = "Invitations"

    @writes(access=Access.OWNER)
    async def delete(self, project: str, invitation: str) -> Rendered:
        """Withdraw an open invitation, named by its `id` or its `prefix`; its code is not valid any more."""
        return await self.answer(issuing.withdraw_invitation, project, invitation)


class ServerInvitations(Resource):
    """Invitations to create an account."""

    path = "/invitations"
    tag = "Invitations"

    @reads(access=Access.ADMINISTRATOR, scope="admin", query=PageQuery, answer=Invitation, paged=True)
    async def get(self, query: PageQuery) -> Rendered:
        """List the open invitations that can create accounts, without their codes."""
        return await self.answer(issuing.list_account_invitations, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.ADMINISTRATOR, scope="admin", body=AccountInvitationCreate, answer=NewInvitation, status=201)
    async def post(self, body: AccountInvitationCreate) -> Rendered:
        """Invite people to create an account and, if the request names a project, to join it.

        The code is shown only once.
        """
        return await self.answer_with(
            lambda made: Reply(made, location=f"/invitations/{made.id}", headers=WITH_SECRET),
            issuing.create_account_invitation,
            body,
        )


class ServerInvitation(Resource):
    """An invitation to create an account."""

    path = "/invitations/{invitation}"
    tag = "Invitations"

    @writes(access=Access.ADMINISTRATOR, scope="admin")
    async def delete(self, invitation: str) -> Rendered:
        """Withdraw an open invitation, named by its `id` or its `prefix`; its code is not valid any more."""
        return await self.answer(issuing.withdraw_account_invitation, invitation)


class InvitationAcceptances(PasswordResource):
    """Acceptance of invitations by users."""

    path = "/invitations/accept"
    tag = "Invitations"

    @writes(
        access=Access.USER,
        body=RequestBody(InvitationAcceptance, max_bytes=MAX_LOGIN_BYTES),
        answer=AcceptedInvitation,
        also=((429, None),),
    )
    async def post(self, body: InvitationAcceptance) -> Rendered:
        """Accept an invitation to a project; you become a member.

        If you have the same or a higher role already, nothing changes, and the invitation is not used.
        """
        attempt = await self.count_code(body.code, accepting.try_of)
        return await self.answer(accepting.accept_invitation, body.code.get_secret_value(), attempt)


class SignUps(PasswordResource):
    """Creation of accounts by invited people."""

    path = "/sign-up"
    tag = "Invitations"

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(SignUp, max_bytes=MAX_LOGIN_BYTES),
        answer=SignedUp,
        status=201,
        also=((429, None),),
        reserved=True,
    )
    async def post(self, body: SignUp) -> Reply:
        """Create your account with an invitation of an administrator, and join the project that the invitation names.

        The answer contains a new token, shown only once. A repeated request with the same name and password gets the
        same membership and another token.
        """
        attempt = await self.count_code(body.code, accepting.try_of)
        password = body.password.get_secret_value()
        if await self.look_up(accepting.needs_password_check, body.code.get_secret_value(), body.name):
            login, verified_hash = await self.check_password(body.name, password)
            made = await self.change(accepting.sign_up_again, body, verified_hash, login, attempt)
        else:
            made = await self.change(accepting.sign_up, body, await self.hash_password(password), attempt)
        return Reply(made, headers=WITH_SECRET)


RESOURCES: tuple[type[Resource], ...] = (
    ProjectInvitations,
    ProjectInvitation,
    ServerInvitations,
    InvitationAcceptances,
    ServerInvitation,
    SignUps,
)
