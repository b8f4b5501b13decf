"""Links that sign a browser in, and the sessions that they begin; a session can only read one project."""

from datetime import datetime

from pydantic import Field, SecretStr

from marey_schemas.base import Answer, Request
from marey_schemas.names import ProjectName

CODE_PREFIX = "mareyview_"
"""Beginning of each code of a link."""

VIEW_PATH = "/view"
"""Path, below the address of the server, of the page that shows clips."""


class BrowserLink(Answer):
    """Code that signs one browser in, once. It belongs in the fragment of an address, which browsers do not send."""

    code: str
    path: str = Field(VIEW_PATH, description="Path of the page that accepts the code, as in `/view#<code>`.")
    expires_at: datetime = Field(description="Time until which the code must be used.")


class BrowserSessionCreate(Request):
    """Request of a page to exchange the code of a link for a cookie."""

    code: SecretStr = Field(max_length=200, description="Code of the link.")


class BrowserSession(Answer):
    """Session of a browser that may read one project, until it expires."""

    project: ProjectName
    expires_at: datetime
