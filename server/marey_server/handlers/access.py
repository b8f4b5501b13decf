"""Resources of the caller, sign-in, tokens and users."""

from __future__ import annotations

from functools import partial

from marey_schemas.access import Login, Me, NewToken, Token, TokenCreate, User, UserChange, UserCreate
from marey_server.access import passwords
from marey_server.access.principal import Principal
from marey_server.errors import ForbiddenProblem
from marey_server.http.declarations import KIB, Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import tokens, users
from marey_server.store.transaction import Transaction

MAX_LOGIN_BYTES = 4 * KIB
"""Greatest size of the body of a sign-in, the only one that a caller without a token may send."""


def read_me(tx: Transaction) -> Me:
    """Return the caller, with the scopes of the credential."""
    principal = tx.principal
    if principal.kind == "attempt" or principal.user_name is None:
        return Me(user=None, scopes=principal.scopes, job=principal.job_id)
    return Me(user=users.find_user(tx, principal.user_name), scopes=principal.scopes)


def sign_in(tx: Transaction, principal: Principal, request: Login) -> NewToken:
    """Return a token for a user whose password was checked."""
    tx.principal = principal
    wanted = TokenCreate(name="sign-in", scopes=principal.scopes, expires_in_s=request.expires_in_s)
    return tokens.create_token(tx, wanted)


def sign_out(tx: Transaction) -> None:
    """Revoke the token of this request."""
    if tx.principal.token_id is not None:
        tokens.revoke_token(tx, tx.principal.token_id)


class MeResource(Resource):
    """The caller."""

    path = "/me"
    tag = "Access"

    @reads(access=Access.SIGNED_IN, scope=None, answer=Me, reserved=True)
    async def get(self) -> Rendered:
        """Return your user and the scopes of your token."""
        return await self.answer(read_me)


class LoginResource(Resource):
    """Sign-in."""

    path = "/login"
    tag = "Access"

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(Login, max_bytes=MAX_LOGIN_BYTES),
        answer=NewToken,
        also=((429, None),),
        reserved=True,
    )
    async def post(self, body: Login) -> Reply:
        """Sign in with name and password; the answer contains a new token, shown only once."""
        self.services.limit_sign_in(body.name, self.request.remote_ip or "")
        async with self.services.sign_in_places:
            principal = await self.look_up(users.verify_password, body.name, body.password.get_secret_value())
        made = await self.change(sign_in, principal, body)
        return Reply(made, headers={"Cache-Control": "no-store"})


class LogoutResource(Resource):
    """Sign-out."""

    path = "/logout"
    tag = "Access"

    @writes(access=Access.USER, scope=None)
    async def post(self) -> Rendered:
        """Revoke the token with which this request is sent."""
        return await self.answer(sign_out)


class OwnTokens(Resource):
    """The caller's tokens."""

    path = "/tokens"
    tag = "Access"

    @reads(access=Access.USER, query=PageQuery, answer=Token, paged=True)
    async def get(self, query: PageQuery) -> Rendered:
        """List your tokens, without their secrets."""
        return await self.answer(tokens.list_tokens, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.USER, body=TokenCreate, answer=NewToken, status=201)
    async def post(self, body: TokenCreate) -> Rendered:
        """Create a token; its secret is shown only once."""
        private = {"Cache-Control": "no-store"}
        return await self.answer_with(
            lambda made: Reply(made, location=f"/tokens/{made.id}", headers=private), tokens.create_token, body
        )


class TokenResource(Resource):
    """A token."""

    path = "/tokens/{token}"
    tag = "Access"

    @writes(access=Access.USER)
    async def delete(self, token: str) -> Rendered:
        """Revoke a token; it stops working at once."""
        return await self.answer(tokens.revoke_token, token)


class AllUsers(Resource):
    """All users."""

    path = "/users"
    tag = "Access"

    @reads(access=Access.ADMINISTRATOR, scope="admin", query=PageQuery, answer=User, paged=True)
    async def get(self, query: PageQuery) -> Rendered:
        """List all users."""
        return await self.answer(users.list_users, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.ADMINISTRATOR, scope="admin", body=UserCreate, answer=User, status=201, etag=True)
    async def post(self, body: UserCreate) -> Rendered:
        """Create a user."""
        password_hash = None
        if body.password is not None:
            await self.look_up(_require_administrator)
            password_hash = await self._hash(body.password.get_secret_value())
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/users/{made.name}"),
            users.create_user,
            body,
            password_hash=password_hash,
        )

    async def _hash(self, password: str) -> str:
        async with self.services.sign_in_places:
            return await self.compute(passwords.hash_password, password)


def _require_administrator(tx: Transaction) -> None:
    users.require_administrator(tx.principal)


class UserResource(Resource):
    """A user."""

    path = "/users/{user}"
    tag = "Access"

    @reads(access=Access.USER, answer=User, etag=True)
    async def get(self, user: str) -> Rendered:
        """Return a user; for administrators, and for the user."""
        return await self.answer(users.find_user, user)

    @writes(access=Access.USER, body=UserChange, answer=User, precondition="required", etag=True)
    async def patch(self, user: str, body: UserChange) -> Rendered:
        """Change a user: administrators may change all fields, users their own display name and password."""
        password_hash = verified_hash = None
        if body.password is not None:
            await self.look_up(users.find_user, user)
            verified_hash = await self._verify(user, body)
            async with self.services.sign_in_places:
                password_hash = await self.compute(passwords.hash_password, body.password.get_secret_value())
        return await self.answer(
            users.change_user,
            user,
            body,
            expected_rev=self.precondition.expected_rev,
            password_hash=password_hash,
            verified_hash=verified_hash,
        )

    async def _verify(self, user: str, body: UserChange) -> str | None:
        """Return the stored hash that the given current password matches.

        Raises `ForbiddenProblem` if it does not match.
        """
        if body.current_password is None:
            return None
        self.services.limit_sign_in(user, self.request.remote_ip or "")
        stored = await self.look_up(users.stored_hash, user)
        check = partial(passwords.password_matches, body.current_password.get_secret_value(), stored)
        async with self.services.sign_in_places:
            if not await self.compute(check):
                raise ForbiddenProblem("The current password is wrong.", code="wrong-password")
        return stored

    @writes(access=Access.ADMINISTRATOR, scope="admin", precondition="required")
    async def delete(self, user: str) -> Rendered:
        """Disable a user: the name remains on the user's work; tokens and password no longer work."""
        return await self.answer(users.delete_user, user, expected_rev=self.precondition.expected_rev)


RESOURCES: tuple[type[Resource], ...] = (
    MeResource,
    LoginResource,
    LogoutResource,
    OwnTokens,
    TokenResource,
    AllUsers,
    UserResource,
)
