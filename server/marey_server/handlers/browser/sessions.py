"""Resources that sign a browser in to read one project: links, and the sessions that they begin."""

from __future__ import annotations

from urllib.parse import urlsplit

from marey_schemas.sign_ins import BrowserLink, BrowserSession, BrowserSessionCreate
from marey_server.handlers.access import MAX_LOGIN_BYTES, PasswordResource
from marey_server.http.browser_cookies import cookie_name, is_secure, require_own_page, sent_cookies
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.credentials import browser_links


class BrowserLinks(Resource):
    """Links that open a project in a browser."""

    path = "/projects/{project}/browser-links"
    tag = "Access"

    @reads(access=Access.READER, answer=BrowserLink, status=201, public=False)
    async def post(self, project: str) -> Rendered:
        """Create a link that signs one browser in, once, within two minutes; the browser may then read the project."""
        return await self.answer_with(lambda made: Reply(made, headers=WITH_SECRET), browser_links.create_link, project)


class BrowserSessions(PasswordResource):
    """Sessions of browsers."""

    path = "/browser-sessions"
    tag = "Access"

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(BrowserSessionCreate, max_bytes=MAX_LOGIN_BYTES),
        answer=BrowserSession,
        status=201,
        also=((429, None),),
        reserved=True,
    )
    async def post(self, body: BrowserSessionCreate) -> Reply:
        """Exchange the code of a link for a cookie, with which the browser may read one project for twelve hours."""
        require_own_page(self.request)
        attempt = await self.count_code(body.code, browser_links.try_of)
        made = await self.change(browser_links.redeem_link, body.code.get_secret_value(), attempt)
        https = self._is_https()
        self.set_cookie(
            cookie_name(made.session.project, https=https), made.secret, path="/", expires=made.session.expires_at,
            secure=https, httponly=True, samesite="Strict",
        )  # fmt: skip
        return Reply(made.session, headers=WITH_SECRET)

    def _is_https(self) -> bool:
        """Return whether the browser has reached the server over https; a proxy may have ended the encryption."""
        address = self.request.headers.get("Origin") or self.services.settings.public_url or ""
        return urlsplit(address).scheme == "https"


class OneBrowserSession(Resource):
    """Session of a browser in one project."""

    path = "/browser-sessions/{project}"
    tag = "Access"

    @writes(access=Access.ANYONE, scope=None, reserved=True)
    async def delete(self, project: str) -> Reply:
        """End the session that the cookie of the request names; without such a cookie, nothing changes."""
        require_own_page(self.request)
        for name, secret in sent_cookies(self.request, project).items():
            if await self.look_up(browser_links.is_session, secret):
                await self.change(browser_links.end_session, secret)
            self.clear_cookie(name, path="/", secure=is_secure(name), httponly=True, samesite="Strict")
        return Reply()


RESOURCES: tuple[type[Resource], ...] = (BrowserLinks, BrowserSessions, OneBrowserSession)
