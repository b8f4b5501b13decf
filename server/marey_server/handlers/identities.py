"""Resources of the sign-in with an identity provider: for programs, for browsers, and for administrators.

A program begins a sign-in and redeems its code; the browser opens two addresses in between. The browser gets pages,
also for errors. The server redirects it only to the identity provider in the settings, or to a port of its own machine.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Coroutine
from typing import Any
from urllib.parse import urlencode, urlsplit

from pydantic import ConfigDict, Field

from marey_schemas.access import NewToken
from marey_schemas.base import Request
from marey_schemas.sign_ins import (
    CALLBACK_PATH,
    BrowserSignIn,
    BrowserSignInCode,
    BrowserSignInCreate,
    Identity,
    IdentityLink,
)
from marey_schemas.sizes import DAY_S
from marey_server.access.secret_tokens import derive_from_cookie
from marey_server.errors import ApiProblem, NotFoundProblem, UnauthenticatedProblem
from marey_server.handlers.access import MAX_LOGIN_BYTES, PasswordResource
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, Bytes, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.short_pages import BROWSER, STYLED, page
from marey_server.process.identity_provider import IdentityProvider
from marey_server.process.password_lanes import limited_address
from marey_server.store.credentials import browser_sign_ins, identities, sign_ins
from marey_server.store.credentials.browser_sign_ins import LIFETIME_US, invalid_sign_in
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.database.clock import datetime_of
from marey_server.store.transaction import Transaction

log = logging.getLogger(__name__)


class ProviderResource(PasswordResource):
    """Base class of resources that need the identity provider."""

    @property
    def provider(self) -> IdentityProvider:
        """The identity provider of the settings. Raises `NotFoundProblem` if there is none."""
        found = self.services.identity_provider
        if found is None:
            raise NotFoundProblem(
                "This server has no identity provider; sign in with a password.", code="no-identity-provider"
            )
        return found


class BrowserResource(ProviderResource):
    """Base class of resources that a browser opens while a person signs in."""

    @property
    def cookie_name(self) -> str:
        """The name of the cookie; the prefix `__Host-` makes browsers accept it only from this host, over https."""
        return "__Host-marey-sign-in" if self.is_https else "marey-sign-in"

    @property
    def is_https(self) -> bool:
        """True if browsers reach the server over https."""
        return urlsplit(self.services.settings.public_url or "").scheme == "https"

    async def shown(self, method: Callable[[], Coroutine[Any, Any, Reply]]) -> Reply:
        """Return the answer of `method`, or a page that describes the error."""
        try:
            if self.request.method == "HEAD":  # which some programs send to addresses in messages
                raise self.method_not_allowed()
            return await method()
        except ApiProblem as error:
            self.problem_code = error.error_code
            headers = self.page_headers | error.headers
            body = page("The sign-in has failed", error.detail)
            return Reply(body, status=error.status, media_type=BROWSER, headers=headers)

    @property
    def page_headers(self) -> dict[str, str]:
        """The headers of a page: browsers run no scripts in the page, and do not store it."""
        return {**WITH_SECRET, "Content-Security-Policy": STYLED}

    def send_browser_to(self, url: str) -> Reply:
        """Return an answer that sends the browser to another address."""
        return Reply(status=303, headers=self.page_headers | {"Location": url})


class BrowserSignIns(ProviderResource):
    """Sign-ins in a browser."""

    path = "/sign-ins"
    tag = "Access"

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(BrowserSignInCreate, max_bytes=MAX_LOGIN_BYTES),
        answer=BrowserSignIn,
        status=201,
        also=((429, None),),
        reserved=True,
    )
    async def post(self, body: BrowserSignInCreate) -> Rendered:
        """Begin a sign-in with the identity provider; a person completes it in a browser."""
        settings, address = self.services.settings, limited_address(self.client_address)
        root = self.provider.redirect_uri.removesuffix(CALLBACK_PATH)

        def begin(tx: Transaction) -> BrowserSignIn:
            longest_s = settings.oidc_longest_days * DAY_S
            made = browser_sign_ins.begin(tx, body, address, settings.login_tries_per_minute, longest_s)
            return BrowserSignIn(
                id=made, url=f"{root}/sign-ins/{made}/open", expires_at=datetime_of(tx.now_us + LIFETIME_US)
            )

        return await self.answer_with(lambda made: Reply(made, headers=WITH_SECRET), begin)


class OpenedSignIn(BrowserResource):
    """Sign-in that a browser opens."""

    path = "/sign-ins/{sign_in}/open"
    tag = "Access"

    @reads(
        access=Access.ANYONE,
        scope=None,
        answer=Bytes,
        answer_types=("text/html",),
        also=((303, None),),
        reserved=True,
        for_browsers=True,
    )
    async def get(self, sign_in: str) -> Reply:
        """Send the browser to the identity provider. Only one browser can open a sign-in, and only once."""

        async def begin() -> Reply:
            cookie, state = secrets.token_urlsafe(32), secrets.token_urlsafe(32)
            nonce, verifier = (derive_from_cookie(cookie, purpose, state) for purpose in ("nonce", "verifier"))
            url = await self.provider.authorization_url(state, nonce, verifier)
            await self.change(browser_sign_ins.open_in_browser, sign_in, cookie, state)
            lasting_s = LIFETIME_US // 1_000_000
            self.set_cookie(
                self.cookie_name, cookie, path="/", max_age=lasting_s, secure=self.is_https, httponly=True,
                samesite="Lax",  # the provider sends the browser back from another site
            )  # fmt: skip
            return self.send_browser_to(url)

        return await self.shown(begin)


class CallbackQuery(Request):
    """Query parameters with which an identity provider sends a browser back; other parameters are ignored."""

    model_config = ConfigDict(extra="ignore")

    state: str = Field("", max_length=200, description="Value of `state` that the server sent to the provider.")
    code: str = Field("", max_length=8192, description="Authorization code, if the person has signed in.")
    iss: str | None = Field(
        None, max_length=512, description="Issuer (RFC 9207): address of the provider, if the provider sends it."
    )
    error: str = Field("", max_length=200, description="Code of the error, if the person has not signed in.")


class SignInCallback(BrowserResource):
    """Address to which the identity provider sends a browser back."""

    path = CALLBACK_PATH
    tag = "Access"

    @reads(
        access=Access.ANYONE,
        scope=None,
        query=CallbackQuery,
        answer=Bytes,
        answer_types=("text/html",),
        also=((303, None),),
        reserved=True,
        for_browsers=True,
    )
    async def get(self, query: CallbackQuery) -> Reply:
        """Check the answer of the identity provider, and give the browser a code for the program that waits."""
        return await self.shown(lambda: self._receive(query))

    async def _receive(self, query: CallbackQuery) -> Reply:
        cookie = self.get_cookie(self.cookie_name) or ""
        provider = self.provider
        if not cookie or not query.state:
            raise invalid_sign_in()
        sign_in, port = await self.change(browser_sign_ins.use_state, query.state, cookie)
        self.clear_cookie(self.cookie_name, path="/", secure=self.is_https, httponly=True, samesite="Lax")
        if query.error or not query.code:
            log.warning("the identity provider sent the error %r", query.error)
            raise UnauthenticatedProblem(
                f"The identity provider has not signed you in ({query.error or 'no code'}). Run the command again.",
                code="sign-in-refused",
            )
        nonce, verifier = (derive_from_cookie(cookie, purpose, query.state) for purpose in ("nonce", "verifier"))
        person = await provider.identify(query.code, query.iss, nonce, verifier)
        code = secrets.token_urlsafe(32)
        creates_users = self.services.settings.oidc_creates_users
        user = await self.change(browser_sign_ins.confirm, sign_in, code, person, creates_users=creates_users)
        if port is not None:
            return self.send_browser_to(f"http://127.0.0.1:{port}/?{urlencode({'sign_in': sign_in, 'code': code})}")
        text = (
            f"You are signed in as {user}. Copy this code into the program that you started. Give it to nobody: with "
            "it, another person could sign in as you."
        )
        return Reply(page("Almost done", text, code), media_type=BROWSER, headers=self.page_headers)


class RedeemedSignIn(ProviderResource):
    """Token of a sign-in that was completed in a browser."""

    path = "/sign-ins/{sign_in}/token"
    tag = "Access"

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(BrowserSignInCode, max_bytes=MAX_LOGIN_BYTES),
        answer=NewToken,
        also=((429, None),),
        reserved=True,
    )
    async def post(self, sign_in: str, body: BrowserSignInCode) -> Reply:
        """Return the token of a sign-in for its code and its verifier; the code works once."""
        address, per_minute = limited_address(self.client_address), self.services.settings.login_tries_per_minute
        attempt = SignInTry(f"sign-in {sign_in}", address, per_minute)
        self.services.refused_tries.check(attempt)
        await self.count(sign_ins.count, attempt)
        made = await self.change(browser_sign_ins.redeem, sign_in, body, attempt)
        return Reply(made, headers=WITH_SECRET)


class UserIdentities(ProviderResource):
    """Identities of a user."""

    path = "/users/{user}/identities"
    tag = "Access"

    @reads(access=Access.USER, query=PageQuery, answer=Identity, paged=True)
    async def get(self, user: str, query: PageQuery) -> Rendered:
        """List the people at identity providers who can sign in as a user.

        Only administrators may read the identities of other users.
        """
        return await self.answer(identities.list_identities, user, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.ADMINISTRATOR, scope="admin", body=IdentityLink, answer=Identity, status=201)
    async def post(self, user: str, body: IdentityLink) -> Rendered:
        """Let a person at an identity provider sign in as a user. A repeated request has no further effect."""
        return await self.answer_with(
            lambda made: Reply(made, location=f"/users/{user}/identities/{made.id}"),
            identities.link_identity,
            user,
            body.issuer or self.services.settings.oidc_issuer,
            body.subject,
        )


class UserIdentity(Resource):
    """An identity of a user."""

    path = "/users/{user}/identities/{identity}"
    tag = "Access"

    @writes(access=Access.ADMINISTRATOR, scope="admin")
    async def delete(self, user: str, identity: str) -> Rendered:
        """Unlink a person at an identity provider from a user; all sessions of the user end, too."""
        return await self.answer(identities.unlink_identity, user, identity)


RESOURCES: tuple[type[Resource], ...] = (
    BrowserSignIns,
    SignInCallback,
    OpenedSignIn,
    RedeemedSignIn,
    UserIdentities,
    UserIdentity,
)
