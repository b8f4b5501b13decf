"""Resource of a project's events, page by page or as server-sent events."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.items import EventFeed
from marey_server.errors import BadRequestProblem, TooManyRequestsProblem
from marey_server.http.caching import NOT_STORED
from marey_server.http.declarations import Access, reads
from marey_server.http.negotiation import EVENT_STREAM
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.store import events, projects
from marey_server.store.wakeups import Listener, events_topic, wakeups

KEEP_ALIVE_S = 15.0
LOOK_AGAIN_EVERY = 4
"""Number of keep-alive comments after which the feed is read without a notification, in case one was lost."""


class EventsQuery(Request):
    """Query parameters for reading events: the position in the feed, and the number of events."""

    after: int = Field(0, ge=0, le=2**62, description="Number of the last event received; 0: from the beginning.")
    limit: int = Field(100, ge=1, le=events.MAX_EVENTS, description="Greatest number of events in a page.")


class Events(Resource):
    """The events of a project."""

    path = "/projects/{project}/events"
    tag = "Events"
    _listener: Listener | None = None

    @reads(
        access=Access.READER,
        query=EventsQuery,
        answer=EventFeed,
        public=False,
        stream=True,
        headers=("Last-Event-ID",),
    )
    async def get(self, project: str, query: EventsQuery) -> Reply | None:
        """Return events in the order of their commits; as text/event-stream, also send events that occur later.

        A page may have fewer events than `limit`, because the bodies of its events have at most 4 MiB together; `more`
        says whether further events exist.

        If events that follow the event `after` were deleted because of their age, the answer is 410 (`events-deleted`).
        `context` then contains the number after which the remaining events begin.
        """
        after = self._last_received(query)
        await self.services.number_events()
        if self.media is not EVENT_STREAM:
            page = await self.look_up(events.list_events, project, after=after, limit=query.limit)
            return Reply(EventFeed(items=tuple(page.items), more=not page.complete))
        project_id = (await self.look_up(projects.require, project)).id
        await self.look_up(events.require_kept, after)
        with self._counted(), wakeups.listen([events_topic(project_id)]) as listener:
            self.set_header("Content-Type", "text/event-stream")
            self.set_header("Cache-Control", NOT_STORED)
            if self.request.method != "HEAD":
                self._listener = listener
                await self._follow(project, after, listener)
        return None

    def on_connection_close(self) -> None:
        """Stop following, because the client has closed the connection."""
        super().on_connection_close()
        if self._listener is not None:
            self._listener.wake()

    @contextmanager
    def _counted(self) -> Iterator[None]:
        """Count this connection for its user while the `with` block runs.

        Raises `TooManyRequestsProblem` if the user already has as many connections as the setting `user_followers`
        allows.
        """
        user, counts = str(self.principal and self.principal.user_id), self.services.followers
        limit = self.services.settings.user_followers
        if counts[user] >= limit:
            raise TooManyRequestsProblem(
                f"You follow events over {counts[user]:,} connections; the limit is {limit:,}. Close some of them.",
                code="too-many-followers",
                context={"quota": "user_followers", "used": counts[user], "limit": limit},
            )
        counts[user] += 1
        try:
            yield
        finally:
            counts[user] -= 1
            if not counts[user]:
                del counts[user]

    def _last_received(self, query: EventsQuery) -> int:
        text = self.request.headers.get("Last-Event-ID")
        if text is None:
            return query.after
        if not text.isascii() or not text.isdigit() or len(text) > 18:
            raise BadRequestProblem("The header Last-Event-ID must be the number of an event.", code="bad-event-id")
        return int(text)

    async def _follow(self, project: str, after: int, listener: Listener) -> None:
        """Send events as they occur, until the client disconnects or the server stops."""
        self.write(": follow\n\n")
        silences = 0
        while self.is_awaited():
            page = events.EventPage([], complete=True)
            if silences % LOOK_AGAIN_EVERY == 0:
                page = await self.look_up(events.list_events, project, after=after, limit=events.MAX_EVENTS)
            for event in page.items:
                self.write(f"id: {event.seq}\nevent: {event.kind}\ndata: {event.model_dump_json()}\n\n")
                after = event.seq
            if silences and not page.items:
                self.write(": still here\n\n")
            if self._write_buffer:
                await self.flush()
            woken = not page.complete or await listener.wait(KEEP_ALIVE_S)
            silences = 0 if woken else silences + 1


RESOURCES: tuple[type[Resource], ...] = (Events,)
