"""Resources for orchestrators and Prometheus: liveness, readiness and metrics, outside the API's root."""

from __future__ import annotations

from marey_schemas.base import Answer
from marey_server.errors import StoppingProblem, UnavailableProblem
from marey_server.http.caching import NOT_STORED
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.store.monitoring import readiness


class Health(Answer):
    """State of the server."""

    status: str


class Healthz(Resource):
    """Liveness of the process."""

    path = "/healthz"
    root = ""
    uneventful = True
    answers_while_stopping = True
    tag = "Operations"

    @reads(access=Access.ANYONE, scope=None, answer=Health)
    async def get(self) -> Reply:
        """Return the status `ok`, which shows that the process answers requests."""
        return Reply(Health(status="ok"), headers={"Cache-Control": NOT_STORED})


class Readyz(Resource):
    """Readiness for requests."""

    path = "/readyz"
    root = ""
    uneventful = True
    answers_while_stopping = True
    tag = "Operations"

    @reads(access=Access.ANYONE, scope=None, answer=Health, also=((503, None),), reserved=True)
    async def get(self) -> Reply:
        """Return whether the server is ready for requests.

        The server is ready if the database is reachable and has the current schema. There must also be space for blobs,
        and the server must not be stopping. If the server is not ready, the log gives the reason; the answer gives the
        reason only to administrators.
        """
        if self.services.draining.is_set():
            raise StoppingProblem
        faults = await self.look_up(readiness.find_faults)
        if disk_fault := self.services.disk.fault():
            faults = [*faults, disk_fault]
        self.services.note_faults(faults)
        if faults:
            shown = self.principal is not None and self.principal.administrator
            reasons = " ".join(f"{fault[:1].upper()}{fault[1:]}." for fault in faults)
            detail = f"The server is not ready. {reasons if shown else 'Its log gives the reason.'}"
            raise UnavailableProblem(detail, code="not-ready", headers={"Retry-After": "5"})
        return Reply(Health(status="ready"), headers={"Cache-Control": NOT_STORED})


class MetricsPage(Resource):
    """Metrics for Prometheus."""

    path = "/metrics"
    root = ""
    uneventful = True
    answers_while_stopping = True
    tag = "Operations"

    @reads(access=Access.ANYONE, scope=None, answer=Bytes, answer_types=("text/plain",))
    async def get(self) -> Reply:
        """Return metrics in the text format of Prometheus."""
        await self.services.refresh_figures()
        text, media_type = await self.services.metrics.exposition()
        return Reply(text, media_type=media_type, headers={"Cache-Control": NOT_STORED})


RESOURCES: tuple[type[Resource], ...] = (Healthz, Readyz, MetricsPage)
