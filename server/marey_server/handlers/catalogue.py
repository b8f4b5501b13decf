"""List of all resources of the server, in the order of the documentation."""

from marey_server.handlers import (
    access,
    annotations,
    blobs,
    collections,
    coverage_streams,
    documentation,
    edits,
    events,
    exports,
    health,
    imports,
    items,
    parts,
    projects,
    reports,
    samples,
    searches,
    uploads,
)
from marey_server.handlers.queue import jobs, leases, pipelines
from marey_server.handlers.versions import contents, datasets, differences, proposals
from marey_server.http.resource import Resource

RESOURCES: tuple[type[Resource], ...] = (
    *access.RESOURCES,
    *projects.RESOURCES,
    *collections.RESOURCES,
    *items.RESOURCES,
    *parts.RESOURCES,
    *differences.RESOURCES,
    *datasets.RESOURCES,
    *proposals.RESOURCES,
    *contents.RESOURCES,
    *annotations.RESOURCES,
    *edits.RESOURCES,
    *exports.RESOURCES,
    *reports.RESOURCES,
    *samples.RESOURCES,
    *searches.RESOURCES,
    *coverage_streams.RESOURCES,
    *imports.RESOURCES,
    *jobs.RESOURCES,
    *pipelines.RESOURCES,
    *leases.RESOURCES,
    *blobs.RESOURCES,
    *uploads.RESOURCES,
    *events.RESOURCES,
    *documentation.RESOURCES,
    *health.RESOURCES,
)
