"""Resources of the reports of evaluations and models, and of the figures in these reports."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.documents.report_pages import PLAYER_PLACE, ReportOrigin, with_origin, with_player
from marey_schemas.documents.reports import REPORTS, StoredFigure, StoredFile
from marey_schemas.documents.reports import Report as ReportDocument
from marey_schemas.items import Revision
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MIB, MOST_INTEGER
from marey_server.errors import NotFoundProblem
from marey_server.handlers.browser.pages import PackedPlayer, packed_player
from marey_server.handlers.items import kind_of
from marey_server.http.caching import REVALIDATED, caching_of_revision
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import BlobSender, attachment
from marey_server.motions import walk_graphs
from marey_server.motions.walk_graphs import MEDIA_TYPES, WalkGraphFormat
from marey_server.store import blobs, items
from marey_server.store.transaction import Transaction

FIGURE_TYPES = {
    "png": "image/png",
    "svg": "image/svg+xml",
    "csv": "text/csv; charset=utf-8",
    "json": "application/json",
}
PAGE_TYPE = "text/html; charset=utf-8"
MOST_FILLED_BYTES = 16 * MIB
"""Greatest size of a page that is read into memory to fill in origin and player; reports have up to a few MB."""
SHOWN_ONLY = "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content-Security-Policy that forbids the page to load, send or store anything."""


class ReportQuery(Request):
    """Query parameters of a report: its revision."""

    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision of the report; absent: the newest.")


class FigureQuery(ReportQuery):
    """Query parameters of a figure: its form, and the revision of the report."""

    format: Literal["png", "svg", "csv", "json"] = Field(
        "png", description="Form of the figure: an image (png, svg) or the plotted data (json, csv)."
    )
    trial: str | None = Field(
        None, max_length=100, description="Name of the trial; only for figures of a single trial."
    )
    table: str | None = Field(
        None, max_length=100, description="Table of the figure to return as CSV; absent: the first table."
    )


class StoredFileSender(BlobSender):
    """Base of resources that answer with a file to which a document or the result of a job refers."""

    async def send_file(self, file: StoredFile, media_type: str, cache_control: str, sandbox: str) -> Rendered | None:
        """Answer with the file and a Content-Security-Policy for browsers that display the file.

        `sandbox` is the part of the policy that restricts scripts.
        """
        return await self.send_blob(
            file.blob,
            disposition="inline",
            media_type=media_type,
            cache_control=cache_control,
            headers={"Content-Security-Policy": f"{SHOWN_ONLY}; {sandbox}"},
        )


class ReportSender(StoredFileSender):
    """Base of resources that answer with the page of a report.

    The stored page has empty places for its origin (project, address, author and time) and for the player of motions.
    They are filled here, because the stored bytes depend only on what the report was computed from (decision record
    0091).
    """

    async def send_report(
        self, file: StoredFile, origin: ReportOrigin, scripts: Sequence[str] = ()
    ) -> Reply | Rendered | None:
        """Answer with the page of a report, in which the origin and, if necessary, the player are filled in.

        `scripts` are digests of the page's scripts. A page gets the player if it runs scripts and has a place for the
        player. Pages above `MOST_FILLED_BYTES` are sent as they are stored.
        """
        self.holding.grow(2 * min(file.size_bytes, MOST_FILLED_BYTES))
        stored = await self.look_up(_read_page, file)
        if stored is None:
            return await self.send_file(file, PAGE_TYPE, REVALIDATED, _sandbox(scripts))
        player = await self.compute(packed_player) if scripts and PLAYER_PLACE.encode() in stored else None
        if player is not None:
            self.holding.grow(len(player.content))
            scripts = [*scripts, player.script]
        page, digest = await self.compute(_filled, stored, origin, player)
        headers = {
            "Cache-Control": REVALIDATED,
            "Content-Disposition": "inline",
            "Content-Security-Policy": f"{SHOWN_ONLY}; {_sandbox(scripts)}",
        }
        return Reply(page, rev=digest, media_type=PAGE_TYPE, headers=headers)

    def origin(self, project: str, author: str | None, made_at: datetime) -> ReportOrigin:
        """Return the origin of a report: project, author, time, and the address of this server for browsers."""
        address = self.services.settings.public_url or f"{self.request.protocol}://{self.request.host}"
        return ReportOrigin(project, address.rstrip("/"), author, made_at)


def _sandbox(scripts: Sequence[str]) -> str:
    """Return the part of the content security policy that allows only the scripts with these digests."""
    return f"script-src {' '.join(map(repr, scripts))}; sandbox allow-scripts" if scripts else "sandbox"


def _read_page(tx: Transaction, file: StoredFile) -> bytes | None:
    """Return the stored page of a report, or None if it is too large to be filled in.

    Also return None if the page is larger than `file` states. `file` is part of a document that a client may have
    written; a false size must not make the server read a large blob into memory.
    """
    size = blobs.require_readable(tx, file.blob)
    return None if size > min(file.size_bytes, MOST_FILLED_BYTES) else blobs.read_blob(tx, file.blob, 0, size)


def _filled(stored: bytes, origin: ReportOrigin, player: PackedPlayer | None) -> tuple[bytes, str]:
    """Fill in the origin and the player, if one is given; return the page and the first 32 digits of its SHA-256."""
    page = with_origin(stored, origin)
    if player is not None:
        page = with_player(page, player.content)
    return page, hashlib.sha256(page).hexdigest()[:32]


class ItemReport(ReportSender):
    """Report of an evaluation or a model."""

    path = "/projects/{project}/{kind}/{item}/report"
    tag = "Reports"

    @reads(
        access=Access.READER,
        query=ReportQuery,
        answer=Bytes,
        answer_types=("text/html",),
        etag=True,
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, project: str, kind: str, item: str, query: ReportQuery) -> Reply | Rendered | None:
        """Return the report of an item (kinds `evaluations`, `models`) as one self-contained HTML page."""
        report, revision = await self.look_up(read_report_of, project, kind_of(kind), item, query.revision)
        origin = self.origin(project, revision.author, revision.created_at)
        return await self.send_report(report.html, origin, report.scripts)


class Figure(StoredFileSender):
    """Figure of a report."""

    path = "/projects/{project}/{kind}/{item}/figures/{figure}"
    tag = "Reports"

    @reads(
        access=Access.READER,
        query=FigureQuery,
        answer=Bytes,
        answer_types=("image/png", "image/svg+xml", "text/csv", "application/json"),
        etag=True,
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, project: str, kind: str, item: str, figure: str, query: FigureQuery) -> Rendered | None:
        """Return a figure of a report (kinds `evaluations`, `models`) as an image, a vector drawing, or its numbers."""
        report = await self.look_up(read_report, project, kind_of(kind), item, query.revision)
        file = file_of(find_figure(report, figure, query.trial), query)
        return await self.send_file(file, FIGURE_TYPES[query.format], caching_of_revision(query.revision), "sandbox")


def read_report_of(
    tx: Transaction, project: str, kind: Kind, item_id: str, number: int | None
) -> tuple[ReportDocument, Revision]:
    """Return the report of an item, and the revision that it belongs to.

    Raises `NotFoundProblem` if the item does not exist or has no report.
    """
    part = items.read_part(tx, project, kind, item_id, "report", revision=number, arrays="none")
    tree: dict[str, Any] = part.tree
    report = _REPORT_OF[tree["schema"]].model_validate(tree)
    return report, items.read_revision(tx, project, kind, item_id, part.revision)


def read_report(tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None) -> ReportDocument:
    """Return the report of an evaluation or a model. Raises `NotFoundProblem` if the item has no report."""
    return read_report_of(tx, project, kind, item_id, revision)[0]


_REPORT_OF = {str(one.model_fields["schema_"].default): one for one in REPORTS}


def find_figure(report: ReportDocument, name: str, trial: str | None) -> StoredFigure:
    """Return the figure of a report with this name and trial.

    Raises `NotFoundProblem` if there is none; the error lists the figures of the report, or the trials of the figure.
    """
    named = [figure for figure in report.figures if figure.name == name]
    for figure in named:
        if figure.trial == trial:
            return figure
    if not named:
        known = ", ".join(dict.fromkeys(figure.name for figure in report.figures))
        raise NotFoundProblem(f"The report has no figure {name!r}; it has {known or 'none'}.", code="no-figure")
    trials = ", ".join(str(figure.trial) for figure in named if figure.trial is not None)
    where = f"for the trials {trials}" if trials else "for all trials together; leave out the trial"
    raise NotFoundProblem(f"The figure {name!r} exists only {where}.", code="no-figure")


def file_of(figure: StoredFigure, query: FigureQuery) -> StoredFile:
    """Return a figure's file in the requested format. Raises `NotFoundProblem` if there is no such CSV table."""
    if query.format != "csv":
        return {"png": figure.png, "svg": figure.svg, "json": figure.json_}[query.format]
    if not figure.csv:
        raise NotFoundProblem(f"The figure {figure.name!r} has no tables.", code="no-table")
    table = query.table or next(iter(figure.csv))
    if table not in figure.csv:
        tables = ", ".join(figure.csv)
        raise NotFoundProblem(f"The figure has no table {query.table!r}; it has {tables}.", code="no-table")
    return figure.csv[table]


class WalkGraphQuery(ReportQuery):
    """Query parameters of a walk graph: its format, and the trial that it shows."""

    format: WalkGraphFormat = Field(
        "json", description="Format of the graph; GraphML can be read by networkx, Gephi, yEd and igraph."
    )
    trial: str | None = Field(None, max_length=100, description="Name of a trial; absent: all trials together.")


class EvaluationWalkGraph(Resource):
    """Walk graph of an evaluation."""

    path = "/projects/{project}/{kind}/{item}/walk-graph"
    tag = "Reports"

    @reads(access=Access.READER, query=WalkGraphQuery, answer=Bytes, answer_types=tuple(MEDIA_TYPES.values()))
    async def get(self, project: str, kind: str, item: str, query: WalkGraphQuery) -> Reply:
        """Return the frames displayed by the trials of an evaluation (kind `evaluations`) and the jumps between them.

        Nodes are frames of clips, with the number of ticks (time steps) for which each was displayed. Edges are jumps,
        with the number of times that each occurred. Walks list the edges of each trial in order.
        """
        source = await self.look_up(walk_graphs.read_walks, project, kind_of(kind), item, query.revision)
        order = partial(walk_graphs.walk_order, source, query.trial, query.format)
        data = await self.compute_apart(walk_graphs.MAKE_WALK_GRAPH, order, bytes)
        headers = {
            "Content-Disposition": attachment(f"{source.name}-walks.{query.format}"),
            "Cache-Control": caching_of_revision(query.revision),
        }
        return Reply(data, media_type=MEDIA_TYPES[query.format], headers=headers)


RESOURCES: tuple[type[Resource], ...] = (ItemReport, Figure, EvaluationWalkGraph)
