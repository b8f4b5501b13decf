"""Sign-in with the identity provider of a team, the identities that are linked with users, and sessions of browsers."""

from datetime import datetime
from typing import Annotated

from pydantic import Field, SecretStr, StringConstraints

from marey_schemas.access import LoginSeconds
from marey_schemas.base import Answer, Request
from marey_schemas.names import ProjectName, form
from marey_schemas.sizes import DAY_S, LOGIN_DAYS

CALLBACK_PATH = "/sign-ins/callback"
"""Path, below the root of the API, to which the identity provider sends the browser back."""

VIEW_PREFIX = "mareyview_"
"""Beginning of each code of a link that opens a project in a browser."""

VIEW_PATH = "/view"
"""Path, below the address of the server, of the page that shows clips."""

PLAYER_PATH = "/pages/player"
"""Path, below the root of the API, of an empty page that clients complete to pages that need no server."""

STUDY_PATH = "/studies"
"""Path, below the address of the server, of the page for the people who carry out a study."""

Subject = Annotated[
    str, StringConstraints(min_length=1, max_length=255, pattern=form(r"^[\x20-\x7e]+$", "have only ASCII characters"))
]
"""Id of a person at an identity provider: at most 255 ASCII characters (OpenID Connect Core, section 2)."""


class BrowserSignInCreate(Request):
    """Request of a program to sign in its user with the identity provider, in a browser."""

    challenge: str = Field(
        pattern=form(r"^[0-9a-f]{64}$", "be 64 hexadecimal digits in lower case"),
        description="SHA-256, in hexadecimal digits, of a random secret that the program keeps, the *verifier*.",
    )
    port: int | None = Field(
        None,
        ge=1024,
        le=65535,
        description="Port on which the program waits for the code, on the machine of the browser: the server "
        "redirects the browser to http://127.0.0.1:<port>/. Null: the browser shows the code, and the person "
        "copies it into the program.",
    )
    expires_in_s: LoginSeconds = Field(
        LOGIN_DAYS * DAY_S, description="Seconds for which the new token is valid; the server may allow fewer."
    )


class BrowserSignIn(Answer):
    """A sign-in that has begun: the person opens `url` in a browser."""

    id: str
    url: str = Field(description="Address to open in a browser; only one browser can open it.")
    expires_at: datetime = Field(description="Time until which the sign-in must be complete.")


class BrowserSignInCode(Request):
    """Request for the token of a sign-in that was completed in a browser."""

    code: SecretStr = Field(max_length=200, description="Code that the browser got or showed.")
    verifier: SecretStr = Field(max_length=200, description="Secret whose SHA-256 is the `challenge` of the sign-in.")


class IdentityLink(Request):
    """Request to link a person at the identity provider with a user."""

    subject: Subject = Field(description="Id of the person at the identity provider: the claim `sub` of its ID tokens.")
    issuer: str | None = Field(
        None,
        max_length=512,
        pattern=form(r"^https?://[\x21-\x7e]+$", "be an address, beginning with https:// or http://"),
        description="Address of the identity provider; null: the provider in the server's settings.",
    )


class Identity(Answer):
    """A person at an identity provider, who can sign in as a user."""

    id: str
    user: str
    issuer: str
    subject: str
    created_at: datetime
    last_used_at: datetime | None = Field(None, description="Time of the last sign-in; null: none yet.")


class BrowserLink(Answer):
    """Code that signs in the first browser that uses it.

    It is put after the `#` of an address, because browsers do not send this part to servers.
    """

    code: str
    path: str = Field(VIEW_PATH, description="Path of a page that accepts the code, as in `/view#<code>`.")
    expires_at: datetime = Field(description="Time until which the code must be used.")


class BrowserSessionCreate(Request):
    """Request of a page to exchange the code of a link for a cookie."""

    code: SecretStr = Field(max_length=200, description="Code of the link.")


class BrowserSession(Answer):
    """Session of a browser that may read one project, until it expires."""

    project: ProjectName
    expires_at: datetime
