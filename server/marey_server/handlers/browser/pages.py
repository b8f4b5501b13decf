"""Pages of the browser, and the files that they load: built from `web/` and part of the package.

Addresses inside the pages are relative to `<base>`, which this module sets to the relative path from the page to the
root of the server. So pages work behind a proxy that serves the server below a path.
"""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
import re
import zlib
from base64 import b64encode
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from pydantic import ConfigDict, Field

from marey_schemas.base import Request
from marey_schemas.sign_ins import PLAYER_PATH
from marey_server.errors import NotFoundProblem
from marey_server.http.caching import IMMUTABLE, NOT_STORED
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.http.short_pages import BROWSER, STYLED, page

FOLDER = Path(__file__).parents[2] / "webui"
"""Folder that the build of `web/` writes."""
_BASE = b'<base href="./" />'
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'self'; "
    "form-action 'none'; frame-ancestors 'none'"
)
_PLAYER_POLICY = "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"
"""Content security policy of a page with inline scripts; `sandbox` keeps the page from using browser sessions."""
_SCRIPT_DIGEST = re.compile(rb"script-src '(sha256-[A-Za-z0-9+/]{43}=)'")
"""Digest of the player's script, in the content security policy that the build writes into the page."""
_MISSING = "This installation contains no pages. Install Node 20.19 or newer, and run `make web` in the source tree."
_TEXTS = ("text/", "application/javascript", "image/svg+xml")


@dataclass(frozen=True, slots=True)
class WebFile:
    """File of the pages, plain and compressed."""

    media_type: str
    content: bytes
    compressed: bytes | None


def built_files() -> dict[str, WebFile]:
    """Return the built files by their path in the build folder; empty if the pages were not built.

    They are read again after each build, so that a developer need not restart the server.
    """
    try:
        return _read_folder((FOLDER / "index.html").stat().st_mtime_ns)
    except FileNotFoundError:
        return {}


@lru_cache(maxsize=1)
def _read_folder(_built_ns: int) -> dict[str, WebFile]:
    found = sorted(file for file in FOLDER.rglob("*") if file.is_file())
    return {file.relative_to(FOLDER).as_posix(): _read(file) for file in found}


def _read(file: Path) -> WebFile:
    kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
    content = file.read_bytes()
    is_text = kind.startswith(_TEXTS)
    media_type = f"{kind}; charset=utf-8" if is_text else kind
    return WebFile(media_type, content, gzip.compress(content, mtime=0) if is_text else None)


@dataclass(frozen=True, slots=True)
class PackedPlayer:
    """Page that plays motion, in the form in which reports contain it.

    `content` is the HTML page, compressed by zlib, in base64. `script` is the digest of the page's script.
    """

    content: str
    script: str


def packed_player() -> PackedPlayer | None:
    """Return the player for reports; None if the pages were not built."""
    found = built_files().get("player.html")
    return None if found is None else _packed(found.content)


@lru_cache(maxsize=1)
def _packed(page: bytes) -> PackedPlayer | None:
    script = _SCRIPT_DIGEST.search(page)
    if script is None:
        return None
    return PackedPlayer(b64encode(zlib.compress(page, 9)).decode(), script[1].decode())


class WebPage(Resource):
    """Base class of pages: all pages are the same HTML document, whose script chooses the page by the address."""

    root = ""
    to_root: ClassVar[bytes]
    """Relative path from the address of the page to the root of the server."""

    async def document(self) -> Reply:
        """Return the document, or a page that names the command that builds the pages."""
        found = (await self.compute(built_files)).get("index.html")
        if found is None:
            headers = {"Cache-Control": NOT_STORED, "Content-Security-Policy": STYLED}
            return Reply(page("No pages", _MISSING), status=404, media_type=BROWSER, headers=headers)
        content = found.content.replace(_BASE, b'<base href="' + self.to_root + b'" />')
        rev = hashlib.sha256(content).hexdigest()[:16]
        return Reply(content, rev=rev, media_type=BROWSER, headers={"Content-Security-Policy": _POLICY})


class AnyQuery(Request):
    """Parameters in the address of a page; the page reads them, and the server ignores them."""

    model_config = ConfigDict(extra="ignore")


class ViewQuery(AnyQuery):
    """Parameters in the address of the page that shows clips."""

    clip: str | None = Field(None, description="The clip: `project/item`, or `project/item@revision`.")
    beside: str | None = Field(None, description="Second clip, which is shown with the first one at the same time.")
    frame: str | None = Field(None, description="Frame at which the first clip begins, counted from 0.")
    camera: str | None = Field(
        None, description="Yaw and pitch of the camera in degrees, and its distance in body heights, as in `35,12,2.6`."
    )
    look: str | None = Field(None, description="Look of the characters: `mannequin` (default) or `skeleton`.")
    layout: str | None = Field(None, description="Layout of two clips: `beside`, `overlaid`, `left` or `right`.")


class ViewPage(WebPage):
    """Page that shows clips."""

    path = "/view"
    tag = "Pages"
    to_root = b"./"

    @reads(
        access=Access.ANYONE, scope=None, query=ViewQuery, answer=Bytes, answer_types=("text/html",),
        also=((404, None),), for_browsers=True,
    )  # fmt: skip
    async def get(self, query: ViewQuery) -> Reply:  # noqa: ARG002 - the page itself reads it
        """Return the page that shows a clip, alone or beside another clip."""
        return await self.document()


class StudyQuery(AnyQuery):
    """Parameters in the address of the page of a study."""

    study: str | None = Field(None, description="The study: `project/item`, or `project/item@revision`.")


class StudyPage(WebPage):
    """Page of a study, for those who carry it out."""

    path = "/studies"
    tag = "Pages"
    to_root = b"./"

    @reads(
        access=Access.ANYONE, scope=None, query=StudyQuery, answer=Bytes, answer_types=("text/html",),
        also=((404, None),), for_browsers=True,
    )  # fmt: skip
    async def get(self, query: StudyQuery) -> Reply:  # noqa: ARG002 - the page itself reads it
        """Return the page that shows the design, the participants and the results of a study."""
        return await self.document()


class ParticipantPage(WebPage):
    """Page of the participants of perceptual studies."""

    path = "/s/"
    tag = "Pages"
    to_root = b"../"

    @reads(
        access=Access.ANYONE, scope=None, query=AnyQuery, answer=Bytes, answer_types=("text/html",),
        also=((404, None),), for_browsers=True,
    )  # fmt: skip
    async def get(self, query: AnyQuery) -> Reply:  # noqa: ARG002 - the page itself reads it
        """Return the page on which a participant compares motions."""
        return await self.document()


class PlayerPage(Resource):
    """Page that contains a motion and plays it without a server; clients insert the motion."""

    path = PLAYER_PATH
    tag = "Pages"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("text/html",))
    async def get(self) -> Reply:
        """Return the page without a motion; a client writes a motion into the element `motion` of the page."""
        found = (await self.compute(built_files)).get("player.html")
        if found is None:
            raise NotFoundProblem(_MISSING)
        rev = hashlib.sha256(found.content).hexdigest()[:16]
        return Reply(found.content, rev=rev, media_type=BROWSER, headers={"Content-Security-Policy": _PLAYER_POLICY})


class PageAsset(Resource):
    """File that the pages load; its name contains a hash of its content."""

    root = ""
    path = "/assets/{asset}"
    tag = "Pages"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes)
    async def get(self, asset: str) -> Reply:
        """Return a script, a style sheet or an icon of the pages."""
        found = (await self.compute(built_files)).get(f"assets/{asset}")
        if found is None:
            raise NotFoundProblem("The pages have no such file; reload the page.")
        headers = {"Cache-Control": IMMUTABLE}
        if found.compressed is None or "gzip" not in self.request.headers.get("Accept-Encoding", ""):
            return Reply(found.content, media_type=found.media_type, headers=headers)
        headers["Content-Encoding"] = "gzip"
        return Reply(found.compressed, media_type=found.media_type, headers=headers)


RESOURCES: tuple[type[Resource], ...] = (ViewPage, StudyPage, ParticipantPage, PlayerPage, PageAsset)
