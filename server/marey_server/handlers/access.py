"""Resources of the caller, sign-in, tokens and users."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from pydantic import Field, SecretStr

from marey_schemas.access import (
    Login,
    Me,
    NewToken,
    QuotaChange,
    QuotasInUse,
    Token,
    TokenCreate,
    TokenRotation,
    User,
    UserChange,
    UserCreate,
)
from marey_schemas.base import Request
from marey_schemas.names import UserName
from marey_schemas.sizes import KIB
from marey_server.access import passwords
from marey_server.access.roles import require_administrator
from marey_server.errors import ForbiddenProblem, TooManyRequestsProblem
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.process.password_lanes import limited_address
from marey_server.store import users
from marey_server.store.credentials import rotation, sign_ins, tokens
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.credentials.tokens import TokenFilter
from marey_server.store.database.clock import datetime_of
from marey_server.store.transaction import Transaction

T = TypeVar("T")

MAX_LOGIN_BYTES = 4 * KIB
"""Greatest size of the body of a sign-in."""


def read_me(tx: Transaction) -> Me:
    """Return the caller, who is a user or an attempt of a job, with the scopes of the credential."""
    principal = tx.principal
    if principal.kind == "attempt" or principal.user_name is None:
        return Me(user=None, scopes=principal.scopes, job=principal.job_id)
    expires_at = None if principal.expires_us is None else datetime_of(principal.expires_us)
    user = users.find_user(tx, principal.user_name)
    return Me(user=user, scopes=principal.scopes, expires_at=expires_at, token=principal.token_id)


def sign_in(tx: Transaction, attempt: SignInTry, verified_hash: str, expires_in_s: int) -> NewToken:
    """Create a session for a user whose password matched `verified_hash`, and return its token.

    Raises `UnauthenticatedProblem` if the user was disabled or has another password now.
    """
    tx.principal = users.authenticated(tx, attempt.name, verified_hash)
    sign_ins.record_success(tx, attempt)
    return tokens.create_session(tx, expires_in_s)


def count_try(tx: Transaction, attempt: SignInTry) -> str | None:
    """Count a try to sign in; return the stored hash that the password must match.

    Return None if no active user with a password has this name. Raises `TooManyRequestsProblem` above the limit of
    tries.
    """
    sign_ins.count(tx, attempt)
    return users.stored_hash(tx, attempt.name)


def sign_out(tx: Transaction) -> None:
    """Revoke the token of this request."""
    if tx.principal.token_id is not None:
        tokens.revoke_token(tx, tx.principal.token_id)


class MeResource(Resource):
    """The caller."""

    path = "/me"
    tag = "Access"

    @reads(access=Access.SIGNED_IN, scope=None, answer=Me, attempts=True, reserved=True)
    async def get(self) -> Rendered:
        """Return your user and the scopes of your token."""
        return await self.answer(read_me)


class PasswordResource(Resource):
    """Base class of resources that check passwords."""

    async def check_password(self, name: str, password: str) -> tuple[SignInTry, str | None]:
        """Count a try to sign in and check its password.

        Return the try and the stored hash, or the try and None if the password does not match. The check takes the same
        time for a user who does not exist. Raises `TooManyRequestsProblem` above the limit of tries, and
        `UnavailableProblem` if too many passwords are being checked.
        """
        services = self.services
        address = limited_address(self.client_address)
        attempt = SignInTry(name, address, services.settings.login_tries_per_minute)
        services.refused_tries.check(attempt)
        known = await self.look_up(sign_ins.is_known, attempt)
        lane = services.password_lane if known else services.unknown_lane
        with lane.place(address):
            stored = await self.count(count_try, attempt)
            matches = await lane.run(passwords.password_matches, password, stored)
        return attempt, stored if matches else None

    async def count(self, function: Callable[[Transaction, SignInTry], T], attempt: SignInTry) -> T:
        """Run `function`, which counts a try to sign in or to use a code, and return its result.

        Raises `TooManyRequestsProblem` if `function` does. The server remembers such a refusal, so that it can refuse
        further tries without the database.
        """
        try:
            return await self.change(function, attempt)
        except TooManyRequestsProblem as refusal:
            self.services.refused_tries.note(attempt, refusal)
            raise

    async def count_code(self, code: SecretStr, try_of: Callable[[str, str, int], SignInTry]) -> SignInTry:
        """Count a try to use the code of a link or an invitation, even if the code is not valid, and return the try.

        `try_of(code, address, limit)` makes the `SignInTry` from the code, the client's address, and the allowed number
        of tries per minute. Raises `TooManyRequestsProblem` above this number.
        """
        per_minute = self.services.settings.login_tries_per_minute
        attempt = try_of(code.get_secret_value(), limited_address(self.client_address), per_minute)
        self.services.refused_tries.check(attempt)
        await self.count(sign_ins.count, attempt)
        return attempt

    async def hash_password(self, password: str) -> str:
        """Return the hash of a new password; call this only for a caller who may set the password."""
        lane = self.services.password_lane
        with lane.place(limited_address(self.client_address)):
            return await lane.run(passwords.hash_password, password)


class LoginResource(PasswordResource):
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
        attempt, verified_hash = await self.check_password(body.name, body.password.get_secret_value())
        if verified_hash is None:
            raise users.wrong_password()
        made = await self.change(sign_in, attempt, verified_hash, body.expires_in_s)
        return Reply(made, headers=WITH_SECRET)


class LogoutResource(Resource):
    """Sign-out."""

    path = "/logout"
    tag = "Access"

    @writes(access=Access.USER, scope=None)
    async def post(self) -> Rendered:
        """Revoke the token with which this request is sent."""
        return await self.answer(sign_out)


class TokenQuery(PageQuery):
    """Query parameters of a list of tokens."""

    user: UserName | None = Field(
        None, description="List the tokens of this user; default: your own. Only for administrators."
    )
    everybody: bool = Field(False, description="List the tokens of all users. Only for administrators.")
    prefix: str | None = Field(
        None,
        max_length=16,
        description="List only the token with this prefix: the part `<prefix>` of `marey_<prefix>_<secret>`.",
    )
    ends_within_s: int | None = Field(
        None, ge=0, le=10 * 365 * 86400, description="List only tokens that expire within this number of seconds."
    )


class RevokeQuery(Request):
    """Query parameters for revoking a token."""

    with_created: bool = Field(False, description="Also revoke the tokens that were created with this token.")


class OwnTokens(Resource):
    """The caller's tokens."""

    path = "/tokens"
    tag = "Access"

    @reads(access=Access.USER, query=TokenQuery, answer=Token, paged=True)
    async def get(self, query: TokenQuery) -> Rendered:
        """List your tokens, without their secrets; administrators may list the tokens of other users."""
        wanted = TokenFilter(query.user, query.everybody, query.prefix, query.ends_within_s)
        return await self.answer(tokens.list_tokens, wanted, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.USER, body=TokenCreate, answer=NewToken, status=201)
    async def post(self, body: TokenCreate) -> Rendered:
        """Create a token; its secret is shown only once."""
        return await self.answer_with(
            lambda made: Reply(made, location=f"/tokens/{made.id}", headers=WITH_SECRET), tokens.create_token, body
        )


class TokenResource(Resource):
    """A token."""

    path = "/tokens/{token}"
    tag = "Access"

    @writes(access=Access.USER, query=RevokeQuery)
    async def delete(self, token: str, query: RevokeQuery) -> Rendered:
        """Revoke a token; it stops working at once. Administrators may revoke the tokens of all users."""
        return await self.answer(tokens.revoke_token, token, with_created=query.with_created)


class RotatedToken(Resource):
    """Rotation of a token."""

    path = "/tokens/{token}/rotate"
    tag = "Access"

    @writes(access=Access.USER, scope=None, body=TokenRotation, answer=NewToken)
    async def post(self, token: str, body: TokenRotation) -> Rendered:
        """Replace the token of this request by a successor with the same rights and the same expiry.

        The replaced token remains valid for `grace_s` seconds. A repeated request gets the same successor.
        """
        return await self.answer_with(lambda made: Reply(made, headers=WITH_SECRET), rotation.rotate_token, token, body)


class AllUsers(PasswordResource):
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
            password_hash = await self.hash_password(body.password.get_secret_value())
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/users/{made.name}"),
            users.create_user,
            body,
            password_hash=password_hash,
        )


def _require_administrator(tx: Transaction) -> None:
    require_administrator(tx.principal)


class UserResource(PasswordResource):
    """A user."""

    path = "/users/{user}"
    tag = "Access"

    @reads(access=Access.USER, answer=User, etag=True)
    async def get(self, user: str) -> Rendered:
        """Return a user. Only administrators may read users other than themselves."""
        return await self.answer(users.find_user, user)

    @writes(access=Access.USER, body=UserChange, answer=User, precondition="required", etag=True)
    async def patch(self, user: str, body: UserChange) -> Rendered:
        """Change a user.

        Users may change their own display name and password; administrators may change all fields of all users.
        """
        password_hash = verified_hash = None
        if body.password is not None:
            await self.look_up(users.find_user, user)
            verified_hash = await self._verify(user, body)
            password_hash = await self.hash_password(body.password.get_secret_value())
        return await self.answer(
            users.change_user,
            user,
            body,
            expected_rev=self.precondition.expected_rev,
            password_hash=password_hash,
            verified_hash=verified_hash,
        )

    async def _verify(self, user: str, body: UserChange) -> str | None:
        """Check the current password in a request, and return the stored hash of this password.

        Return None if the request contains no current password. Raises `ForbiddenProblem` if the password is wrong.
        """
        if body.current_password is None:
            return None
        _, stored = await self.check_password(user, body.current_password.get_secret_value())
        if stored is None:
            raise ForbiddenProblem("The current password is wrong.", code="wrong-password")
        return stored

    @writes(access=Access.ADMINISTRATOR, scope="admin", precondition="required")
    async def delete(self, user: str) -> Rendered:
        """Disable a user: tokens and password become invalid; the user is still shown as author."""
        return await self.answer(users.delete_user, user, expected_rev=self.precondition.expected_rev)


class UserQuotas(Resource):
    """Quotas of a user."""

    path = "/users/{user}/quotas"
    tag = "Access"

    @reads(access=Access.USER, answer=QuotasInUse)
    async def get(self, user: str) -> Rendered:
        """Return how many items and bytes a user has stored, and the limits.

        Only administrators may read the quotas of other users.
        """
        return await self.answer(users.read_quotas, user)

    @writes(access=Access.ADMINISTRATOR, scope="admin", body=QuotaChange, answer=QuotasInUse)
    async def patch(self, user: str, body: QuotaChange) -> Rendered:
        """Change the limits of a user."""
        return await self.answer(users.change_quotas, user, body)


RESOURCES: tuple[type[Resource], ...] = (
    MeResource,
    LoginResource,
    LogoutResource,
    OwnTokens,
    TokenResource,
    RotatedToken,
    AllUsers,
    UserResource,
    UserQuotas,
)
