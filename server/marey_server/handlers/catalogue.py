"""Every resource that the server offers, in the order of the documentation."""

from marey_server.handlers import (
    access,
    annotations,
    blobs,
    collections,
    coverage_streams,
    documentation,
    evaluations,
    events,
    exports,
    health,
    imports,
    items,
    jobs,
    leases,
    parts,
    pipelines,
    projects,
    uploads,
)
from marey_server.handlers.resource import Resource

RESOURCES: tuple[type[Resource], ...] = (
    *access.RESOURCES,
    *projects.RESOURCES,
    *collections.RESOURCES,
    *items.RESOURCES,
    *parts.RESOURCES,
    *annotations.RESOURCES,
    *exports.RESOURCES,
    *evaluations.RESOURCES,
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
