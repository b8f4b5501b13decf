"""Resources of the reports of evaluations and models, and of the figures in these reports."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.documents.reports import REPORTS, StoredFigure, StoredFile
from marey_schemas.documents.reports import Report as ReportDocument
from marey_schemas.kinds import Kind
from marey_server.errors import NotFoundProblem
from marey_server.handlers.items import kind_of
from marey_server.http.caching import caching_of_revision
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.queries import MAX_INTEGER
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import BlobSender, attachment
from marey_server.motions import walk_graphs
from marey_server.motions.walk_graphs import MEDIA_TYPES, WalkGraphFormat
from marey_server.store import items
from marey_server.store.transaction import Transaction

FIGURE_TYPES = {
    "png": "image/png",
    "svg": "image/svg+xml",
    "csv": "text/csv; charset=utf-8",
    "json": "application/json",
}
SHOWN_ONLY = "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content-Security-Policy that forbids the page to load, send or store anything."""


class ReportQuery(Request):
    """Query parameters of a report: its revision."""

    revision: int | None = Field(None, ge=1, le=MAX_INTEGER, description="Revision of the report; absent: the newest.")


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
        """Answer with the file; a content security policy with `sandbox` restricts browsers that display the file."""
        return await self.send_blob(
            file.blob,
            disposition="inline",
            media_type=media_type,
            cache_control=cache_control,
            headers={"Content-Security-Policy": f"{SHOWN_ONLY}; {sandbox}"},
        )


class ItemReport(StoredFileSender):
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
    async def get(self, project: str, kind: str, item: str, query: ReportQuery) -> Rendered | None:
        """Return the report of an item (kinds `evaluations`, `models`) as one self-contained HTML page."""
        report = await self.look_up(read_report, project, kind_of(kind), item, query.revision)
        caching = caching_of_revision(query.revision)
        return await self.send_file(report.html, "text/html; charset=utf-8", caching, _scripts(report))


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


def _scripts(report: ReportDocument) -> str:
    """Return the part of the content security policy that allows only the page's own scripts, listed by digest."""
    if not report.scripts:
        return "sandbox"
    return f"script-src {' '.join(repr(digest) for digest in report.scripts)}; sandbox allow-scripts"


def read_report(tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None) -> ReportDocument:
    """Return the report of an evaluation or a model. Raises `NotFoundProblem` if the item has no report."""
    part: dict[str, Any] = items.read_part(tx, project, kind, item_id, "report", revision=revision, arrays="none").tree
    return _REPORT_OF[part["schema"]].model_validate(part)


_REPORT_OF = {str(one.model_fields["schema_"].default): one for one in REPORTS}


def find_figure(report: ReportDocument, name: str, trial: str | None) -> StoredFigure:
    """Return a figure of a report. Raises `NotFoundProblem`, which lists the figures of the report."""
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
