"""Placeholders in stored reports, which the server replaces when it sends a report.

The bytes of a stored report depend only on inputs, parameters, seed and version of the code, so that identical jobs can
share a report. Project, author and date differ from job to job. So a stored page has an empty place for them, and one
for the program that plays motion. The server fills both places. A command that draws a page itself fills the first.
"""

from __future__ import annotations

import html
from datetime import UTC, datetime
from typing import NamedTuple

ORIGIN_PLACE = '<template id="origin"></template>'
"""Placeholder of the facts about a report's origin, in a `dl`. Texts cannot contain it, because each `<` is escaped."""
PLAYER_PLACE = '<template id="player"></template>'
"""Placeholder of the program that plays motion; only pages with motion have it."""


class ReportOrigin(NamedTuple):
    """Origin of a report: facts that its bytes do not depend on.

    Parameters
    ----------
    project : name of the project
    address : address of the server, without a slash at the end
    author : name of the user who requested the report; None if unknown, for example because the user no longer exists
    made_at : time at which the result was published; of a report that is not stored, the time at which it was drawn
    """

    project: str
    address: str
    author: str | None
    made_at: datetime

    def facts(self) -> list[tuple[str, str]]:
        """Return the facts as pairs of a name and a text."""
        written = self.made_at.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
        place = f"{self.project} on {self.address}" if self.address else self.project
        author = [] if self.author is None else [("requested by", self.author)]
        return [("project", place), *author, ("date", written)]


def with_origin(page: bytes, origin: ReportOrigin) -> bytes:
    """Return a page with the facts about its origin; a page without the placeholder stays as it is."""
    groups = (f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>" for name, value in origin.facts())
    return page.replace(ORIGIN_PLACE.encode(), "".join(groups).encode(), 1)


def with_player(page: bytes, packed: str) -> bytes:
    """Return a page with the program that plays its motion; pages without motion stay as they are.

    `packed` is the page `player.html`, compressed by zlib and encoded in base64.
    """
    filled = f'<script type="application/json" id="player">"{packed}"</script>'
    return page.replace(PLAYER_PLACE.encode(), filled.encode(), 1)
